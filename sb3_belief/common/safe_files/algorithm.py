"""Algorithms whose files are read without running anything of whoever made them."""

import io
import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeVar

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_belief.common.safe_files.models import add_plain_data, load_model_zip, read_model, write_model
from sb3_belief.common.safe_files.trust import Trust

if TYPE_CHECKING:
    _Algorithm = BaseAlgorithm
else:
    # A base class here would come before those of the mixins that follow this one
    _Algorithm = object

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="SafeFilesMixin")


class SafeFilesMixin(_Algorithm):
    """Stands before SB3's class among the bases of an algorithm whose ``load`` needs no pickle."""

    def save(
        self,
        path: str | os.PathLike[str] | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save the model as SB3 does. The zip also holds as plain data what SB3 pickles in it, so that ``load`` needs no pickle.

        :param path: Path of the file (".zip" is added to a name without a suffix), or an open binary file
        :param exclude: As SB3's
        :param include: As SB3's
        """
        buffer = io.BytesIO()
        super().save(buffer, exclude, include)
        add_plain_data(buffer, self)
        write_model(path, buffer.getvalue())

    @classmethod
    def load(
        cls: type[SelfAlgorithm],
        path: str | os.PathLike[str] | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: Any = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trust_pickle: bool = False,
        allow_packages: Iterable[str] = (),
        **kwargs: Any,
    ) -> SelfAlgorithm:
        """
        Load a model as SB3 does, without running anything of whoever made the file.

        :param path: Path of the file, with or without ".zip", or an open binary file
        :param env: As SB3's
        :param device: As SB3's
        :param custom_objects: As SB3's: what replaces saved attributes
        :param print_system_info: As SB3's
        :param force_reset: As SB3's
        :param trust_pickle: Whether to load what is pickled, too: files of SB3 alone and of earlier versions, and functions. A
            pickle can run any code of whoever made the file
        :param allow_packages: Packages of your own of which the file may name classes and functions
        :param kwargs: As SB3's: arguments that replace the saved ones
        :return: The model
        :raises ValueError: If the file is damaged, or needs a pickle or a package that is not trusted
        """
        content, where = read_model(path)
        trust = Trust.of(trust_pickle, allow_packages)
        options = dict(env=env, device=device, print_system_info=print_system_info, force_reset=force_reset)
        return load_model_zip(super().load, content, where, trust, custom_objects, **options, **kwargs)
