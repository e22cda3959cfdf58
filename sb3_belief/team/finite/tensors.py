"""What an update changes in a model: parameters, buffers of its networks, and the state of its optimizers."""

import cmath
from collections import defaultdict
from collections.abc import Iterable
from copy import deepcopy
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_belief.team.model_parts import modules_of, optimizers_of


class Place(NamedTuple):
    """
    Where a tensor is found.

    :param name: Its name, for messages
    :param owner: The dict that holds it
    :param key: Its key there
    :param is_buffer: Whether it is a buffer of a network, which may hold infinities: masks of attention do
    """

    name: str
    owner: Any
    key: Any
    is_buffer: bool = False

    @property
    def tensor(self) -> th.Tensor:
        """The tensor."""
        return self.owner[self.key].detach()

    def is_bad(self, tensor: th.Tensor) -> th.Tensor:
        """
        Tell which values should not be there.

        :param tensor: Of this place
        :return: bool, of the same shape
        """
        return th.isnan(tensor) if self.is_buffer else ~th.isfinite(tensor)


class ModelTensors:
    """
    Finds the tensors of a model that an update changes.

    Networks and optimizers are looked for once. Their tensors are looked for again when any has been replaced.

    :param model: The model
    """

    def __init__(self, model: BaseAlgorithm):
        self.model = model
        self._modules: dict[int, tuple[str, nn.Module]] = {}
        self._optimizers: dict[int, tuple[str, th.optim.Optimizer]] = {}
        # Algorithms have second names for parts of their policies
        for path, module in sorted(modules_of(model), key=_not_of_the_policy):
            self._modules.setdefault(id(module), (path, module))
        for path, optimizer in sorted(optimizers_of(model).items(), key=_not_of_the_policy):
            self._optimizers.setdefault(id(optimizer), (path, optimizer))
        self._places: list[Place] = []
        self._known: tuple[list[int], list[int]] | None = None

    def last_layers(self) -> list[th.Tensor]:
        """Return of what each optimizer trains the last parameter: the bias next to the loss, in most networks."""
        return [parameters[-1].detach() for _, optimizer in self.optimizers() if (parameters := _parameters(optimizer))]

    def optimizers(self) -> Iterable[tuple[str, th.optim.Optimizer]]:
        """Return the optimizers with their paths."""
        return self._optimizers.values()

    def places(self) -> list[Place]:
        """Return the places of all tensors, each tensor once; the same list as before as long as it is right."""
        if self._known is None or self._known != self._identities():
            self._places = self._found_places()
            self._known = self._identities()
        return self._places

    def _identities(self) -> tuple[list[int], list[int]]:
        """Return what differs when a tensor, its memory or the state of an optimizer has been replaced."""
        states = [id(s) for _, optimizer in self._optimizers.values() for s in optimizer.state.values()]
        # A buffer may be None at first
        states += [id(buffer) for _, module in self._modules.values() for buffer in module._buffers.values()]
        tensors = [place.owner.get(place.key) for place in self._places]
        return states, [0 if tensor is None else id(tensor) ^ tensor.data_ptr() for tensor in tensors]

    def _found_places(self) -> list[Place]:
        found: dict[int, Place] = {}
        for path, module in self._modules.values():
            for tensors, is_buffer in ((module._parameters, False), (module._buffers, True)):
                for name, tensor in tensors.items():
                    if tensor is not None and id(tensor) not in found:
                        found[id(tensor)] = Place(f"{path}.{name}", tensors, name, is_buffer)
        own = vars(self.model)
        for name, value in own.items():
            # Such as SAC's log_ent_coef
            if isinstance(value, th.Tensor) and id(value) not in found:
                found[id(value)] = Place(name, own, name)
        places = list(found.values())
        for path, optimizer in self.optimizers():
            for i, parameter in enumerate(_parameters(optimizer)):
                state = optimizer.state.get(parameter, {})
                whose = found[id(parameter)].name if id(parameter) in found else f"its parameter {i}"
                places += [Place(f"{path}: {k} of {whose}", state, k) for k, v in state.items() if isinstance(v, th.Tensor)]
        return places


class Flat:
    """
    Tensors of one device and type, and a copy of them in one vector: so one operation copies them, and another checks them.

    :param tensors: The tensors
    :param vector: Is written into if it has the right size; otherwise a new one is made
    """

    def __init__(self, tensors: list[th.Tensor], vector: th.Tensor | None = None):
        self._tensors = [tensor.detach() for tensor in tensors]
        contiguous = all(tensor.is_contiguous() for tensor in tensors)
        self._views = [tensor.view(-1) for tensor in self._tensors] if contiguous else None
        size = sum(tensor.numel() for tensor in tensors)
        if vector is None or len(vector) != size:
            vector = th.empty(size, dtype=tensors[0].dtype, device=tensors[0].device)
        self.vector = vector

    def copy(self) -> None:
        """Copy the tensors into the vector."""
        th.cat(self._views or [tensor.reshape(-1) for tensor in self._tensors], out=self.vector)

    def seems_finite(self) -> bool:
        """Return False if any value of the copy is not finite, and rarely without reason, if the values are huge."""
        # A sum is not finite if one of its terms is not. Its value is of no interest
        return cmath.isfinite(self.vector.sum().item())

    def parts(self) -> list[th.Tensor]:
        """Return the copies of the tensors, in their shapes."""
        parts = self.vector.split([tensor.numel() for tensor in self._tensors])
        return [part.view(tensor.shape) for part, tensor in zip(parts, self._tensors, strict=True)]


class Snapshot:
    """A copy of what an update changes in a model, to be put back."""

    def __init__(self) -> None:
        self._places: list[Place] = []
        self._groups: dict[Any, tuple[list[Place], Flat]] = {}
        self._numbers: list[tuple[Any, dict[str, Any]]] = []
        self._n_updates = 0

    @th.no_grad()
    def take(self, tensors: ModelTensors) -> bool:
        """
        Copy.

        :param tensors: Of the model
        :return: Whether all that was copied is finite
        """
        places = tensors.places()
        if places is not self._places:
            groups = defaultdict[Any, list[Place]](list)
            for place in places:
                groups[place.tensor.device, place.tensor.dtype, place.is_buffer].append(place)
            before = {key: flat.vector for key, (_, flat) in self._groups.items()}
            self._groups = {key: (p, Flat([x.tensor for x in p], before.get(key))) for key, p in groups.items()}
            self._places = places
        self._numbers = [
            (parameter, {name: deepcopy(v) for name, v in state.items() if not isinstance(v, th.Tensor)})
            for _, optimizer in tensors.optimizers()
            for parameter in _parameters(optimizer)
            if (state := optimizer.state.get(parameter)) is not None
        ]
        self._n_updates = getattr(tensors.model, "_n_updates", 0)
        for _, flat in self._groups.values():
            flat.copy()
        return not self.bad_tensors()

    def bad_tensors(self) -> dict[str, str]:
        """Return what the copy holds that it should not, by the names of the tensors: ``"3 of 64 values are not finite"``."""
        bad = {}
        for (_, dtype, _), (places, flat) in self._groups.items():
            if (dtype.is_floating_point or dtype.is_complex) and not flat.seems_finite():
                for place, part in zip(places, flat.parts(), strict=True):
                    if count := int(place.is_bad(part).sum()):
                        bad[place.name] = f"{count} of {part.numel()} values are not finite"
        return bad

    def largest(self) -> tuple[float, str]:
        """Return the largest absolute value of a parameter, and the name of that parameter."""
        found = [
            (float(part.abs().max()), place.name)
            for places, flat in self._groups.values()
            for place, part in zip(places, flat.parts(), strict=True)
            if isinstance(place.owner.get(place.key), nn.Parameter) and part.numel()
        ]
        return max(found, default=(0.0, ""))

    @th.no_grad()
    def put_back(self, tensors: ModelTensors) -> None:
        """
        Give a model what was copied, written into the tensors that it has: optimizers and others refer to them.

        :param tensors: Of the model
        """
        numbers = {id(parameter): values for parameter, values in self._numbers}
        for _, optimizer in tensors.optimizers():
            for parameter in _parameters(optimizer):
                parameter.grad = None
                if id(parameter) not in numbers:
                    # It had not been trained yet
                    optimizer.state.pop(parameter, None)
                elif parameter in optimizer.state:
                    optimizer.state[parameter].update(deepcopy(numbers[id(parameter)]))
        # By their names, since somebody may have loaded another state into an optimizer in between
        present_places = {place.name: place for place in tensors.places()}
        for places, flat in self._groups.values():
            for saved, part in zip(places, flat.parts(), strict=True):
                place = present_places.get(saved.name, saved)
                present = place.owner.get(place.key)
                if present is not None and present.shape == part.shape:
                    present.detach().copy_(part)
                else:
                    place.owner[place.key] = part.clone()
        if hasattr(tensors.model, "_n_updates"):
            tensors.model._n_updates = self._n_updates


def _not_of_the_policy(named: tuple[str, Any]) -> bool:
    return named[0].partition(".")[0] != "policy"


def _parameters(optimizer: th.optim.Optimizer) -> list[th.Tensor]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]
