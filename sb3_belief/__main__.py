"""``python -m sb3_belief``, the same as the command ``sb3-belief``."""

import sys

from sb3_belief.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
