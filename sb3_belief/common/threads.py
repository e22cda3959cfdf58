"""How many threads torch computes with."""

import torch as th


def use_threads(number: int) -> None:
    """
    Have torch compute with a number of threads.

    The networks are small, and threads that wait for each other cost more than they compute: on two busy cores a short
    ``adapt`` took 58 s with two threads and 11 s with one.

    :param number: At least 1; -1 leaves torch's number as it is
    """
    if number > 0:
        th.set_num_threads(number)
