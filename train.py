"""Train a team, as ``sb3-belief train`` does: ``python train.py --algo belief_ppo --env traffic-junction-medium``."""

import sys

from sb3_belief.cli.main import train_main

if __name__ == "__main__":
    sys.exit(train_main())
