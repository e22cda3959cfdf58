"""Two cores against one: Traffic Junction's ten agents with a belief, side by side or one after the other."""

import torch as th

from benchmarks.measure import cores, ratio
from benchmarks.report import Report
from benchmarks.teams import TeamLoop, junction_team
from sb3_belief import Team

_KEY = "two_cores_vs_one"


def largest_difference(a: Team, b: Team) -> float:
    """
    :param a: a team
    :param b: another one with the same agents
    :return: the largest difference between a parameter of the one and of the other; 0 if they have learned the same
    """
    differences = []
    for agent, model in a.agents.items():
        pairs = zip(model.policy.parameters(), b.agents[agent].policy.parameters(), strict=True)
        differences += [float((first - second).abs().max()) for first, second in pairs]
    return max(differences)


def run(report: Report) -> None:
    """
    :param report: what is found goes there
    """
    report.title("cores", f"Traffic Junction as in b, belief_ppo, {cores()} cores")
    if cores() < 2:
        report.skip(_KEY, "there is one core only")
        return
    loops = {f"{n} job{'s' * (n > 1)}": TeamLoop(junction_team("belief_ppo", report.quick, jobs=n)) for n in (1, 2)}
    one, two = loops.values()
    samples = report.measure("cores", loops)
    report.add_ratio(_KEY, ratio(samples["2 jobs"], samples["1 job"], "wall"), "wall speed with two jobs / one")
    with th.no_grad():
        difference = largest_difference(one.team, two.team)
    report.time["cores"] = {"largest_difference_of_parameters": difference}
    print(f"  parameters after the same training: {'equal' if difference == 0 else f'they differ by up to {difference:g}'}")
