"""The agents' value networks."""

import pytest
import torch as th

from sb3_belief.references.agent_net import AgentNet, AgentValues

B, T, N, D, U = 3, 4, 2, 5, 3


def inputs():
    return th.randn(B, T, N, D), th.nn.functional.one_hot(th.randint(U, (B, T, N)), U).float()


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("recurrent", [True, False])
def test_an_episode_in_one_pass_is_that_step_by_step(recurrent, share):
    net = AgentNet(N, D, U, hidden_dim=8, recurrent=recurrent, share=share)
    obs, last = inputs()
    q, features, after = net(obs, last, net.initial_hidden(B))
    assert q.shape == (B, T, N, U) and features.shape == (B, T, N, 8) and after.shape == (B, N, 8)
    hidden = net.initial_hidden(B)
    for t in range(T):
        step, _, hidden = net(obs[:, t : t + 1], last[:, t : t + 1], hidden)
        assert th.allclose(step[:, 0], q[:, t], atol=1e-6)
    assert th.allclose(hidden, after, atol=1e-6)


@pytest.mark.parametrize(("recurrent", "share"), [(True, True), (True, False), (False, True)])
def test_agents_and_episodes_are_apart(recurrent, share):
    net = AgentNet(N, D, U, recurrent=recurrent, share=share)
    obs, last = inputs()
    q, _, _ = net(obs, last, net.initial_hidden(B))
    obs[1, :, 1] += 1
    changed, _, _ = net(obs, last, net.initial_hidden(B))
    moved = (changed != q).any(dim=-1).any(dim=1)
    assert moved.tolist() == [[False, False], [False, True], [False, False]]


def test_only_a_recurrent_one_remembers():
    obs, last = inputs()
    for recurrent in (True, False):
        net = AgentNet(N, D, U, recurrent=recurrent)
        q, _, _ = net(obs, last, net.initial_hidden(B))
        changed, _, _ = net(th.cat([obs[:, :1] + 1, obs[:, 1:]], dim=1), last, net.initial_hidden(B))
        assert th.equal(changed[:, 1:], q[:, 1:]) is not recurrent


def test_shared_weights_know_who_they_act_for():
    obs, last = th.ones(1, 1, N, D), th.zeros(1, 1, N, U)
    net = AgentNet(N, D, U)
    q, _, _ = net(obs, last, net.initial_hidden(1))
    assert not th.allclose(q[0, 0, 0], q[0, 0, 1])
    own = AgentNet(N, D, U, share=False)
    assert len(own.nets) == N and len(net.nets) == 1
    assert sum(p.numel() for p in own.parameters()) == N * sum(p.numel() for p in net.parameters()) - N * N * 64


def test_the_last_action_is_seen():
    net = AgentNet(N, D, U, recurrent=False)
    obs, last = inputs()
    q, _, _ = net(obs, last, net.initial_hidden(B))
    assert not th.equal(net(obs, 1 - last, net.initial_hidden(B))[0], q)


def test_greedy_takes_the_lowest_of_equal_and_legal_ones():
    inf = float("inf")
    values = AgentValues(th.tensor([[[-inf, 2.0, 2.0], [1.0, 1.0, 1.0]]]), th.zeros(1, 2, 1), th.zeros(1, 1))
    assert values.greedy().tolist() == [[1, 0]]
    assert values.of(th.tensor([[2, 1]])).tolist() == [[2, 1]]
    assert values.one_hot(th.tensor([[2, 1]])).tolist() == [[[0, 0, 1], [0, 1, 0]]]
