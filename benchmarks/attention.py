"""
The belief's attention with its own backward pass, against two ways to let PyTorch record one.

    python -m benchmarks.attention

prints CPU milliseconds of a forward and a backward pass, medians of rounds in turn, and the largest difference of results and
gradients. ``recorded`` multiplies with all rows and spreads the weights over them, ``gathered`` copies each query's kept rows.
"""

import argparse
import statistics
from collections.abc import Callable

import torch as th

from benchmarks.measure import alternate, speeds
from sb3_belief.belief.attention import attend

Attention = Callable[[th.Tensor, th.Tensor, th.Tensor], th.Tensor]
# Rows of a minibatch, rows of the history, kept ones, width
SIZES = ((256, 800, 40, 64), (640, 800, 40, 64), (256, 6400, 320, 64))


def recorded(queries: th.Tensor, rows: th.Tensor, kept: th.Tensor) -> th.Tensor:
    scores = queries @ rows.T
    weights = scores.gather(1, kept.long()).softmax(dim=1)
    return th.zeros_like(scores).scatter(1, kept.long(), weights) @ rows


def gathered(queries: th.Tensor, rows: th.Tensor, kept: th.Tensor) -> th.Tensor:
    weights = (rows[kept] @ queries[:, :, None]).squeeze(2).softmax(dim=1)
    return (weights[:, None] @ rows[kept]).squeeze(1)


def ours(queries: th.Tensor, rows: th.Tensor, kept: th.Tensor) -> th.Tensor:
    return attend(queries, rows, rows, kept)[0]


WAYS: dict[str, Attention] = {"ours": ours, "recorded": recorded, "gathered": gathered}


def compare(sizes: tuple[int, int, int, int], rounds: int) -> tuple[dict[str, float], float]:
    """
    :param sizes: rows of a minibatch, rows of the history, kept ones, width
    :param rounds: measurements of each way
    :return: milliseconds of each way, and the largest difference between any two
    """
    th.manual_seed(0)
    n_queries, n_rows, n_selected, width = sizes
    inputs = [(width**-0.25 * th.randn(n, width)).requires_grad_() for n in (n_queries, n_rows)]
    kept = th.rand(n_queries, n_rows).topk(n_selected, dim=1).indices.sort(dim=1).values.int()
    upstream = th.randn(n_queries, width)

    def run(way: Attention) -> list[th.Tensor]:
        output = way(inputs[0], inputs[1], kept)
        return [output.detach(), *th.autograd.grad(output, inputs, upstream)]

    def loop(way: Attention) -> Callable[[], int]:
        def passes() -> int:
            for _ in range(4):
                run(way)
            return 4

        return passes

    results = [run(way) for way in WAYS.values()]
    difference = max(float((a - b).abs().max()) for other in results[1:] for a, b in zip(results[0], other, strict=True))
    samples = alternate({name: loop(way) for name, way in WAYS.items()}, rounds)
    return {name: 1000 / statistics.median(speeds(taken)) for name, taken in samples.items()}, difference


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=25)
    args = parser.parse_args()
    th.set_num_threads(1)
    print(
        f"{'minibatch':>9} {'history':>8} {'kept':>5} {'width':>6}" + "".join(f" {name:>9}" for name in WAYS) + "   difference"
    )
    for sizes in SIZES:
        times, difference = compare(sizes, args.rounds)
        row = "{:>9} {:>8} {:>5} {:>6}".format(*sizes) + "".join(f" {time:>6.2f} ms" for time in times.values())
        print(f"{row}   {difference:.0e}", flush=True)


if __name__ == "__main__":
    main()
