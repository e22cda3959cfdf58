"""Random streams: every agent draws from generators of its own, although SB3 draws from the global ones."""

import random

import numpy as np
import torch as th
from numpy.random import mtrand


class RngState:
    """
    What one party draws from: a state of each of the global generators that SB3 draws from (torch's on the CPU and on every
    CUDA device in use, numpy's). Only one stream is the current one; ``suspend`` and ``resume`` exchange them.

    numpy's global generator is exchanged as an object, since reading its state takes about 100 times as long. The only thing
    lost by that is the second normal number that ``np.random.normal`` keeps back: it is drawn anew after an exchange.

    :param seed: where the stream starts; None: from the operating system's entropy
    """

    def __init__(self, seed: int | None = None):
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._numpy = np.random.MT19937()
        # As np.random.seed() does it: a model that seeds itself and one that does not draw the same numbers for the same seed
        self._numpy._legacy_seeding(seed)
        self._torch = th.Generator().manual_seed(seed).get_state()
        #: For ``RngSwitch``: what Python's generator starts from where this stream is the first
        self.python = random.Random(seed).getstate()
        self._cuda: list[th.Tensor] = []

    def resume(self) -> None:
        """Make this the current stream."""
        th.default_generator.set_state(self._torch)
        mtrand.set_bit_generator(self._numpy)
        if self._cuda:
            th.cuda.set_rng_state_all(self._cuda)

    def suspend(self) -> None:
        """Note how far this stream, the current one, has come."""
        self._torch = th.default_generator.get_state()
        if th.cuda.is_initialized():
            self._cuda = th.cuda.get_rng_state_all()

    def become(self, other: "RngState") -> None:
        """
        :param other: where this one is from now on; neither is the current one
        """
        self._torch, self._numpy = other._torch, other._numpy


class RngSwitch:
    """
    Lends the global generators to one stream after another, as a context manager that puts the caller's own state back.

    Python's generator, whose state is slow to exchange and which no algorithm of SB3 draws from, is lent once, to the first
    stream: environments and callbacks of a team share it.

    :param stream: who draws at the beginning
    """

    def __init__(self, stream: RngState):
        self._first = stream
        self._current = stream

    def __enter__(self) -> "RngSwitch":
        # The caller may hold back a normal number in numpy's generator, so its state is read in full
        self._callers = RngState(0)
        self._callers.suspend()
        self._callers_python = random.getstate()
        self._callers_numpy = mtrand.get_bit_generator(), np.random.get_state(legacy=False)
        self._current = self._first
        self._current.resume()
        random.setstate(self._first.python)
        return self

    def __exit__(self, *_: object) -> None:
        self._current.suspend()
        self._first.python = random.getstate()
        self._callers.resume()
        random.setstate(self._callers_python)
        bit_generator, state = self._callers_numpy
        mtrand.set_bit_generator(bit_generator)
        np.random.set_state(state)

    def to(self, stream: RngState) -> None:
        """
        :param stream: who draws from now on
        """
        if stream is not self._current:
            self._current.suspend()
            stream.resume()
            self._current = stream
