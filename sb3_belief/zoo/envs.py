"""``sb3-belief envs``: which environments there are, and whether one keeps the contract."""

from sb3_belief.envs.registry import registered_ids
from sb3_belief.envs.suites import SUITES
from sb3_belief.zoo.errors import ConfigError, unknown
from sb3_belief.zoo.names import load_env
from sb3_belief.zoo.yaml_data import parse_pairs

# A family with more names than this is listed in full only if it is asked for
_SHORT = 12


def list_envs(family: str | None = None) -> str:
    """
    :param family: only the ids of this one, all of them
    :return: what there is, what is installed, and what installs the rest
    :raises ConfigError: for an unknown family
    """
    if family is None:
        parts = [_block("Registered", registered_ids())]
        parts += [_family(name) for name in SUITES]
        parts.append("<module>:<callable>\n  anything that returns a PettingZoo ParallelEnv (its package: --allow-package)")
        return "\n\n".join(parts)
    if family not in SUITES:
        raise unknown("envs list", "family", family, SUITES)
    return _family(family, full=True)


def _family(name: str, full: bool = False) -> str:
    family = SUITES[name]
    if family.missing():
        return _block(f"{name}/<name>: not installed", [family.install, *([family.note] if family.note else [])])
    names = family.known_names()
    lines = [f"{name}/{each}" for each in (names if full else names[:_SHORT])]
    if len(names) > len(lines):
        lines.append(f"... and {len(names) - len(lines)} more: sb3-belief envs list {name}")
    return _block(f"{name}/<name>: installed", lines)


def _block(title: str, lines: list[str]) -> str:
    return "\n  ".join([title, *lines])


def check_env(
    env_id: str, env_kwargs: list[str], n_steps: int = 500, seed: int = 0, extra_packages: tuple[str, ...] = ()
) -> bool:
    """
    Play an environment, and print what of a team's contract it keeps.

    :param env_id: a registered id, ``family/name`` or ``module:callable``
    :param env_kwargs: ``key:value`` pairs for the environment
    :param n_steps: how long to play
    :param seed: of the environment
    :param extra_packages: see ``names.resolve``
    :return: whether nothing has to be changed
    :raises ConfigError: if there is no such environment
    """
    from sb3_belief.envs.env_checker import check_team_env

    load_env(env_id, "envs check", extra_packages)
    try:
        report = check_team_env(env_id, parse_pairs(env_kwargs, "--env-kwargs"), n_steps, seed)
    except (ValueError, ImportError) as error:
        raise ConfigError(f"envs check: {error}") from error
    print(report)
    return not report.failures
