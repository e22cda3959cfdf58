"""Models of any algorithm, loaded from the contents of their zips."""

from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_belief.belief_ppo.algorithm import BeliefAlgorithmMixin
from sb3_belief.common.plain_data.kinds import Misfit, find
from sb3_belief.common.safe_files.models import NamedContent, load_model_zip
from sb3_belief.common.safe_files.trust import Trust


def find_algorithm(name: str, where: str, trust: Trust) -> type[BaseAlgorithm]:
    """
    Import the class of a saved model.

    :param name: ``"module:qualname"``, as a file has it
    :param where: What the model is called in messages
    :param trust: Whom the file may name
    :return: The class
    :raises ValueError: If it may not be named, cannot be imported, or is not an SB3 algorithm
    """
    try:
        found: Any = find(name, trust.allowed, lambda found: True)
    except Misfit as error:
        raise ValueError(
            f"{where} is a {name[:200]}, but {error}. Classes of your own packages may be named with"
            " allow_packages=('my_package',) (--allow-package)."
        ) from error
    if not issubclass(found, BaseAlgorithm):
        raise ValueError(f"{where} is a {name}, which is not an SB3 algorithm.")
    return found


def load_algorithm(
    algo_class: type[BaseAlgorithm],
    content: bytes,
    where: str,
    trust: Trust,
    custom_objects: dict[str, Any] | None,
    **kwargs: Any,
) -> BaseAlgorithm:
    """
    Load a model by its class.

    :param algo_class: The class
    :param content: Its zip
    :param where: What the model is called in messages
    :param trust: Whom the file may name
    :param custom_objects: As for SB3's ``load``
    :param kwargs: Further arguments of it
    :return: The model
    :raises ValueError: If the file is damaged, or needs a pickle or a package that is not trusted
    """
    if issubclass(algo_class, BeliefAlgorithmMixin):
        file = NamedContent(content, where)
        return algo_class.load(file, custom_objects=custom_objects, **trust._asdict(), **kwargs)
    return load_model_zip(algo_class.load, content, where, trust, custom_objects, **kwargs)
