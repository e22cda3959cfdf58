"""
Read a file with marl-eval as its README documents, and print what it makes of it.

It runs in an environment that has marl-eval and need not have this package.
"""

import contextlib
import json
import sys

import numpy as np


def main(path: str) -> None:
    """Print marl-eval's own checks, its matrices of the final scores and its tensors of the curves as JSON."""
    from marl_eval.utils.data_processing_utils import create_matrices_for_rliable, data_process_pipeline
    from marl_eval.utils.diagnose_data_errors import DiagnoseData

    with open(path, encoding="utf-8") as file:
        raw = json.load(file)
    # It prints what it finds
    with contextlib.redirect_stdout(sys.stderr):
        checks = DiagnoseData(raw).check_data()
        processed = data_process_pipeline(raw_data=raw, metrics_to_normalize=["return"])
        found = {}
        for environment in raw:
            matrices, tensors = create_matrices_for_rliable(
                data_dictionary=processed, environment_name=environment, metrics_to_normalize=["return"]
            )
            tensors.pop("extra")
            found[environment] = {"final": matrices, "curves": tensors}
    json.dump({"checks": checks, "found": found}, sys.stdout, default=np.ndarray.tolist)


if __name__ == "__main__":
    main(sys.argv[1])
