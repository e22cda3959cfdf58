"""Prints what torchrl's QMIX mixer makes of the weights and inputs in a file; run by a Python that has torchrl."""

import json
import sys

import torch
from torchrl.modules.models.multiagent import QMixer

given = torch.load(sys.argv[1], weights_only=True)
n_agents, state_dim = given["q"].shape[1], given["state"].shape[1]
mixer = QMixer((state_dim,), given["embedding_dim"], n_agents, "cpu").double()
mixer.load_state_dict(given["weights"])
print(json.dumps(mixer.mix(given["q"].unsqueeze(-1), given["state"]).squeeze(-1).tolist()))
