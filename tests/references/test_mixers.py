"""The mixers' defining equations, by hand."""

import itertools
from typing import Any

import pytest
import torch as th
from torch import nn

from sb3_belief.references.agent_net import AgentValues
from sb3_belief.references.mixers import QMIX, QPLEX, VDN, Mixer, ParallelLinear
from sb3_belief.references.qtran import QTRAN

STATE = th.zeros(1, 1)


def constant(network: nn.Module, values) -> None:
    """Have a network return the same whatever it is given."""
    linear: Any = [module for module in network.modules() if isinstance(module, nn.Linear | ParallelLinear)][-1]
    linear.weight.data.zero_()
    linear.bias.data = th.as_tensor(values, dtype=th.float32).reshape(linear.bias.shape)


def mixed(mixer: Mixer, q_taken, q_max) -> float:
    onehot = th.zeros(1, mixer.n_agents, mixer.n_actions)
    onehot[..., 0] = 1
    with th.no_grad():
        return mixer(th.tensor([q_taken]), th.tensor([q_max]), onehot, STATE).item()


def test_vdn_adds():
    assert mixed(VDN(2, 2, 1), [1.0, 0.5], [3.0, 3.0]) == 1.5


@pytest.mark.parametrize("hypernet_dim", [None, 64])
def test_qmix_by_hand(hypernet_dim):
    mixer = QMIX(2, 2, 1, embedding_dim=1, hypernet_dim=hypernet_dim)
    for network, raw in [(mixer.w1, [-1, 2]), (mixer.b1, -1), (mixer.w2, 3), (mixer.b2, 0.5)]:
        constant(network, raw)
    assert mixed(mixer, [1.0, 0.5], [9.0, 9.0]) == pytest.approx(3.5, abs=1e-4)
    assert mixed(mixer, [0.0, 0.0], [9.0, 9.0]) == pytest.approx(-1.3964, abs=1e-4)


def test_qmix_has_the_layers_of_the_paper():
    shapes = {name: tuple(weight.shape) for name, weight in QMIX(3, 5, 7).named_parameters() if weight.ndim == 2}
    assert shapes == {
        "w1.0.weight": (64, 7),
        "w1.2.weight": (96, 64),
        "b1.weight": (32, 7),
        "w2.0.weight": (64, 7),
        "w2.2.weight": (32, 64),
        "b2.0.weight": (32, 7),
        "b2.2.weight": (1, 32),
    }


def test_qplex_by_hand():
    mixer = QPLEX(2, 2, 1, n_kernels=1)
    constant(mixer.w, [1, -2])
    constant(mixer.b, [0, 1])
    # lambda = 2 * (1, 1/4) * 1
    constant(mixer.keys, -2)
    constant(mixer.agents, [40, -th.log(th.tensor(3.0))])
    constant(mixer.actions, [40, 40])
    assert mixed(mixer, [1.0, 0.0], [1.0, 3.0]) == pytest.approx(5, abs=1e-4)
    assert mixed(mixer, [1.0, 3.0], [1.0, 3.0]) == pytest.approx(8, abs=1e-4)


@pytest.mark.parametrize(("n_kernels", "n_layers"), [(4, 1), (10, 3)])
def test_qplex_keeps_what_is_best(n_kernels, n_layers):
    for seed in range(20):
        th.manual_seed(seed)
        # In double precision, in which no sigmoid is rounded to zero
        mixer = QPLEX(3, 4, 2, n_kernels, n_layers).double()
        for parameter in mixer.parameters():
            nn.init.normal_(parameter)
        q, features = th.randn(1, 3, 4, dtype=th.float64) * 5, th.zeros(1, 3, 1, dtype=th.float64)
        values = AgentValues(q, features, th.randn(1, 2, dtype=th.float64))
        joint = {}
        for actions in itertools.product(range(4), repeat=3):
            joint[actions] = mixer.joint_value(values, th.tensor([actions])).item()
        assert max(joint, key=lambda actions: joint[actions]) == tuple(values.greedy()[0].tolist())


@pytest.mark.parametrize("n_layers", [1, 3])
def test_qplex_importance_depends_on_state_and_actions(n_layers):
    mixer = QPLEX(2, 2, 1, n_kernels=2, n_layers=n_layers)
    first, second = th.eye(2)[None], th.eye(2).flip(0)[None]
    at = mixer.importance(first, STATE)
    assert at.shape == (1, 2) and (at > 0).all()
    assert not th.equal(at, mixer.importance(second, STATE)) and not th.equal(at, mixer.importance(first, STATE + 1))
    assert sum(isinstance(module, ParallelLinear) for module in mixer.keys.modules()) == n_layers


def test_parallel_layers_are_layers_of_their_own():
    layers = ParallelLinear(3, 4, 2)
    first = nn.Linear(4, 2)
    layers.weight.data[1], layers.bias.data[1, 0] = first.weight.data.T, first.bias.data
    rows = th.randn(5, 4)
    out = layers(rows)
    assert out.shape == (3, 5, 2) and th.allclose(out[1], first(rows), atol=1e-6) and not th.allclose(out[0], out[2])
    assert th.allclose(layers(rows.expand(3, -1, -1)), out)


def test_qplex_advantage_passes_no_gradient():
    mixer = QPLEX(2, 2, 1)
    q_taken, q_max = th.tensor([[1.0, 2.0]], requires_grad=True), th.tensor([[3.0, 4.0]], requires_grad=True)
    mixer(q_taken, q_max, th.eye(2)[None], STATE).sum().backward()
    assert q_max.grad is None and q_taken.grad is not None
    assert th.allclose(q_taken.grad, mixer.w(STATE).abs())


def test_qmix_is_monotone():
    mixer = QMIX(3, 2, 4)
    q = th.randn(50, 3, requires_grad=True)
    mixer(q, q, th.zeros(50, 3, 2), th.randn(50, 4)).sum().backward()
    assert q.grad is not None and (q.grad >= 0).all() and (q.grad > 0).any()


@pytest.mark.parametrize(("joint", "nopt"), [(2.0, 0.25), (1.0, 0.0)])
def test_qtran_by_hand(joint, nopt):
    # Qjt(best) = 3, V = 1, sum Q_i(best) = 1, sum Q_i(u) = .5
    values = AgentValues(th.tensor([[[0.5, 0.25], [0.5, 0.25]]]), th.zeros(1, 2, 1), STATE)
    taken = th.tensor([[1, 1]])
    losses = []
    for coefs in ((1.0, 0.0), (0.0, 1.0)):
        qtran = QTRAN(2, 2, 1, features_dim=1, opt_coef=coefs[0], nopt_coef=coefs[1])
        constant(qtran.joint, 3)
        constant(qtran.value, 1)
        losses.append(qtran.consistency_loss(values, taken, th.tensor([[joint]])).item())
    assert losses == pytest.approx([1.0, nopt])


def test_qtran_joint_value_is_of_the_actions_whoever_takes_them():
    qtran = QTRAN(2, 2, 1, features_dim=3)
    features = th.randn(1, 2, 3)
    values = AgentValues(th.zeros(1, 2, 2), features, STATE)
    swapped = AgentValues(th.zeros(1, 2, 2), features.flip(1), STATE)
    at = qtran.joint_value(values, th.tensor([[0, 1]]))
    assert th.allclose(at, qtran.joint_value(swapped, th.tensor([[1, 0]])))
    assert not th.allclose(at, qtran.joint_value(values, th.tensor([[1, 0]])))


def test_qtran_consistency_does_not_move_the_joint_value():
    qtran = QTRAN(2, 2, 1, features_dim=3)
    q = th.randn(1, 2, 2, requires_grad=True)
    values = AgentValues(q, th.randn(1, 2, 3), STATE)
    taken = th.tensor([[0, 1]])
    qtran.consistency_loss(values, taken, qtran.joint_value(values, taken)).sum().backward()
    assert all(parameter.grad is None for parameter in [*qtran.joint.parameters(), *qtran.encoder.parameters()])
    assert all(parameter.grad is not None for parameter in qtran.value.parameters()) and q.grad is not None
