"""The files that an agent is exported to."""

import logging
import os
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from torch.distributions import Distribution

from sb3_belief.export.graph import PolicyGraph

#: The formats, and how the names of their files end
FORMATS: MappingProxyType[str, str] = MappingProxyType({"onnx": ".onnx", "torch": ".pt2"})


def export_model(
    model: BaseAlgorithm, path: str | os.PathLike[str], file_format: str, statistics: VecNormalize | None = None
) -> PolicyGraph:
    """
    Write an agent's policy, its history included, to a file that needs neither this package nor Stable-Baselines3.

    The file takes any number of observations at once. What goes in and comes out is described at :class:`PolicyGraph`.

    :param model: The agent's model
    :param path: Path of the file, which is replaced if it exists
    :param file_format: ``"onnx"``, or ``"torch"`` for PyTorch's exported programs (``torch.export.load``)
    :param statistics: Its normalisation, if it has one. The file then takes observations before they are normalised
    :return: What has been exported
    :raises ValueError: If the format is unknown, the path ends otherwise, or the policy cannot be exported
    :raises ModuleNotFoundError: If a package is missing; the message has the line that installs it
    """
    if file_format not in FORMATS:
        raise ValueError(f"the format is {file_format!r}; it must be one of {', '.join(map(repr, FORMATS))}")
    if Path(path).suffix != FORMATS[file_format]:
        # PyTorch reads its programs only by this name
        raise ValueError(
            f"{os.fspath(path)!r} is to be written in the format {file_format!r}; end it in {FORMATS[file_format]}"
        )
    graph = PolicyGraph(model, statistics).eval()
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with _tracing(), tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        # A file that is there already is replaced when the new one is complete
        written = Path(folder) / target.name
        (_write_onnx if file_format == "onnx" else _write_torch)(graph, written)
        written.replace(target)
    return graph


@contextmanager
def _tracing() -> Iterator[None]:
    """Set what PyTorch needs to trace a graph, and keep its exporters' remarks on their own insides from the user."""
    checks, log = Distribution._validate_args, logging.getLogger("torch.onnx")
    level = log.level
    # The checks of torch's distributions look at values, which a graph does not have yet
    Distribution.set_default_validate_args(False)
    log.setLevel(logging.ERROR)
    try:
        with th.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
        Distribution.set_default_validate_args(checks)


def _traced(graph: PolicyGraph) -> tuple[tuple[th.Tensor, ...], tuple[Any, ...]]:
    """Return the inputs with which a graph is traced, and that the number of their rows is open."""
    # With a single row PyTorch would take the number of rows for a constant
    inputs, rows = graph.examples(2), th.export.Dim("batch")
    return inputs, (tuple({0: rows} for _ in inputs),)


def _write_torch(graph: PolicyGraph, path: Path) -> None:
    inputs, dynamic_shapes = _traced(graph)
    with open(path, "wb") as file:
        th.export.save(th.export.export(graph, inputs, dynamic_shapes=dynamic_shapes), file)


def _write_onnx(graph: PolicyGraph, path: Path) -> None:
    try:
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Writing ONNX needs {error.name}, which is not installed: pip install 'sb3-belief[export]'", name=error.name
        ) from error
    inputs, dynamic_shapes = _traced(graph)
    program = th.onnx.export(
        graph,
        inputs,
        dynamic_shapes=dynamic_shapes,
        input_names=graph.input_names,
        output_names=list(graph(*inputs)),
        dynamo=True,
        verbose=False,
    )
    assert program is not None
    program.save(path, external_data=False)
