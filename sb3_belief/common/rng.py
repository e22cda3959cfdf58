"""Random number generators of each agent's own, although SB3 draws from the global ones."""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.random import mtrand


class RngState:
    """
    State of the global generators from which SB3 draws: numpy's, and torch's on the CPU and on every CUDA device in use.

    ``resume`` puts the state into the global generators and ``suspend`` takes it from them, so at most one ``RngState`` is
    current at a time.

    numpy's global generator is exchanged as an object, because reading its state takes about 100 times as long. The object
    does not hold the second normal number that ``np.random.normal`` keeps for its next call, so that number is drawn anew
    after an exchange.

    :param seed: Seed of all generators. None to take one from the operating system's entropy
    """

    def __init__(self, seed: int | None = None):
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._numpy = np.random.MT19937()
        # np.random.seed() seeds in the same way, so a model draws the same numbers whether or not it seeds numpy itself
        self._numpy._legacy_seeding(seed)
        self._torch = th.Generator().manual_seed(seed).get_state()
        #: State of Python's generator. ``RngSwitch`` uses it, and only that of the ``RngState`` that it starts with
        self.python = random.Random(seed).getstate()
        self._cuda: list[th.Tensor] = []

    @classmethod
    def from_global(cls) -> "RngState":
        """
        Return a state that the present global generators determine, for whom no seed is given.

        So a caller who seeds them (``set_random_seed(0)``, ``np.random.seed(0)``, ``torch.manual_seed(0)``) repeats a run, as
        with SB3. Each kind of generator is derived from the global one of its kind, which is advanced by one draw.
        """
        state = cls(int(np.random.randint(2**32, dtype=np.uint32)))
        state._torch = th.Generator().manual_seed(int(th.randint(2**31, (1,)))).get_state()
        state.python = random.Random(random.getrandbits(32)).getstate()
        return state

    def resume(self) -> None:
        """Make this the current state, from which SB3 draws."""
        th.default_generator.set_state(self._torch)
        mtrand.set_bit_generator(self._numpy)
        if self._cuda:
            th.cuda.set_rng_state_all(self._cuda)

    def suspend(self) -> None:
        """Store how far the global generators have advanced since this state was resumed."""
        # numpy's generator is this object's own and has advanced in place, so there is nothing to store
        self._torch = th.default_generator.get_state()
        # Asking for the state of a CUDA device would initialise CUDA in a process that does not use it
        if th.cuda.is_initialized():
            self._cuda = th.cuda.get_rng_state_all()

    def generator(self) -> np.random.Generator:
        """Return numpy's newer interface to the same numbers: what is drawn from it advances this state."""
        return np.random.Generator(self._numpy)

    def get(self) -> dict[str, Any]:
        """Return the state as plain data. It must not be the current one."""
        return {"numpy": self._numpy.state, "torch": self._torch, "python": self.python, "cuda": list(self._cuda)}

    def set(self, state: dict[str, Any]) -> None:
        """
        Take over a state. This must not be the current one.

        :param state: As :meth:`get` returned it
        """
        self._numpy.state = state["numpy"]
        self._torch, self.python, self._cuda = state["torch"], state["python"], state["cuda"]

    def become(self, other: "RngState") -> None:
        """
        Take over the state of another one. Neither of the two may be current.

        Only numpy's generator and torch's on the CPU are taken over, which are those of an agent that learns in a worker.

        :param other: State to take over
        """
        self._torch, self._numpy = other._torch, other._numpy


@contextmanager
def sampling_from(space: spaces.Space, generator: np.random.Generator) -> Iterator[None]:
    """
    Have a space draw its samples from another generator within the block.

    :param space: The space, none of Dict or Tuple, whose parts have generators of their own
    :param generator: What it draws from
    """
    own, space._np_random = space._np_random, generator
    try:
        yield
    finally:
        space._np_random = own


# Held by the thread in which a team's generators are the global ones
_in_use = threading.RLock()


@contextmanager
def global_rngs_of_this_thread() -> Iterator[None]:
    """
    Keep other threads from exchanging the global generators, which all threads share, within the block.

    :raises RuntimeError: If another thread does so already
    """
    if not _in_use.acquire(blocking=False):
        raise RuntimeError(
            "Another thread of this process is building a team or lets one learn. Both would draw from the process's global"
            " random number generators, so one would change what the other learns: use a process for each"
            " (concurrent.futures.ProcessPoolExecutor), or let them learn one after the other."
        )
    try:
        yield
    finally:
        _in_use.release()


class RngSwitch:
    """
    Context manager in which the global generators switch between several states.

    At its end the caller's own state is restored. Only one thread can be within such contexts.

    Python's generator is slow to exchange and no algorithm of SB3 draws from it. It therefore uses the state of the first
    ``RngState`` throughout, which a team's environments and callbacks share.

    :param rng: The first state, current when the context begins
    """

    def __init__(self, rng: RngState):
        self._first = rng
        self._current = rng
        self._exclusive = global_rngs_of_this_thread()

    def __enter__(self) -> "RngSwitch":
        self._exclusive.__enter__()
        # The caller's numpy generator may keep a normal number for its next call, which the generator object does not hold.
        # Its state is therefore read in full, which is slow but happens only once
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
        self._exclusive.__exit__(None, None, None)

    @contextmanager
    def put_aside(self) -> Iterator[None]:
        """No state is current within the block, so that each can be read and replaced."""
        self._current.suspend()
        self._first.python = random.getstate()
        try:
            yield
        finally:
            self._current.resume()
            random.setstate(self._first.python)

    def to(self, rng: RngState) -> None:
        """
        Switch to another state.

        :param rng: The state that is current from now on
        """
        if rng is not self._current:
            self._current.suspend()
            rng.resume()
            self._current = rng
