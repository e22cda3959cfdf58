"""
The belief's attention with its own backward pass, against two ways to let PyTorch record one.

    python -m benchmarks.attention

What is measured is a forward and a backward pass. ``dense`` multiplies each query with all rows and scatters the weights over
them; ``gathered`` copies the selected rows of each query.
"""

import argparse
from collections.abc import Callable

import torch as th

from benchmarks.measure import Loop, ratio
from benchmarks.report import Report
from sb3_belief.belief.attention import attend

Attention = Callable[[th.Tensor, th.Tensor, th.Tensor, th.Tensor], tuple[th.Tensor, th.Tensor]]
# Rows of a minibatch, rows of the history, rows selected by each query, width
SIZES = ((256, 800, 40, 64), (640, 800, 40, 64), (256, 6400, 320, 64))


def dense(queries: th.Tensor, keys: th.Tensor, values: th.Tensor, selected: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    scores, indices = queries @ keys.T, selected.long()
    weights = scores.gather(1, indices).softmax(dim=1)
    return th.zeros_like(scores).scatter(1, indices, weights) @ values, weights


def gathered(queries: th.Tensor, keys: th.Tensor, values: th.Tensor, selected: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    weights = (keys[selected] @ queries[:, :, None]).squeeze(2).softmax(dim=1)
    return (weights[:, None] @ values[selected]).squeeze(1), weights


def passes(way: Attention, sizes: tuple[int, int, int, int]) -> Loop:
    """Return a loop over four forward and backward passes at one of ``SIZES``."""
    rng = th.Generator().manual_seed(0)
    n_queries, n_rows, n_selected, width = sizes
    queries, rows = [(width**-0.25 * th.randn(n, width, generator=rng)).requires_grad_() for n in (n_queries, n_rows)]
    selected = th.rand(n_queries, n_rows, generator=rng).topk(n_selected, dim=1).indices.sort(dim=1).values.int()
    grad = th.randn(n_queries, width, generator=rng)

    def loop() -> int:
        for _ in range(4):
            th.autograd.grad(way(queries, rows, rows, selected)[0], (queries, rows), grad)
        return 4

    return loop


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=25, help="measurements of each way")
    th.set_num_threads(1)
    report = Report(parser.parse_args().rounds, quick=False)
    ways: dict[str, Attention] = {"own backward pass": attend, "dense": dense, "gathered": gathered}
    for sizes in SIZES:
        report.title("attention", "minibatch of {}, history of {}, {} selected, width {}".format(*sizes))
        samples = report.measure("attention", {name: passes(way, sizes) for name, way in ways.items()}, "passes")
        ours, *others = samples.values()
        for name, taken in zip(("dense", "gathered"), others, strict=True):
            report.add_ratio(f"own_vs_{name}", ratio(taken, ours), f"CPU time of the own backward pass / {name}")


if __name__ == "__main__":
    main()
