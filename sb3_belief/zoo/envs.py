"""The command ``sb3-belief envs``, which lists the environments and checks whether one fits a team."""

from sb3_belief.envs.registry import registered_ids
from sb3_belief.envs.suites import SUITES, comma_separated
from sb3_belief.zoo.checks import Location, check_call
from sb3_belief.zoo.errors import ConfigError, cause, unknown_setting
from sb3_belief.zoo.names import get_env, load_env
from sb3_belief.zoo.yaml_data import parse_pairs

# In the list of all suites, only this many names of each are shown
_SHORT = 12


def list_envs(suite: str | None = None) -> str:
    """
    Return the list of environments that ``sb3-belief envs`` prints.

    :param suite: Suite whose ids are all listed. None for the registered ids and the first ids of each suite
    :return: Ids of what is installed, and command lines that install the rest
    :raises ConfigError: For an unknown suite
    """
    if suite is None:
        parts = [_block("Registered", registered_ids())]
        parts += [_suite_block(name) for name in SUITES]
        parts.append(
            "<module>:<callable>\n  any callable that returns a PettingZoo ParallelEnv (its package: --allow-package)"
        )
        return "\n\n".join(parts)
    if suite not in SUITES:
        raise unknown_setting("envs list", "suite", suite, SUITES)
    return _suite_block(suite, full=True)


def _suite_block(name: str, full: bool = False) -> str:
    suite = SUITES[name]
    if suite.missing():
        return _block(f"{name}/<name>: not installed", [suite.install, *([suite.note] if suite.note else [])])
    lacking = {each: suite.missing_for(each) for each in suite.known_names()}
    names = [each for each, (modules, _) in lacking.items() if not modules]
    lines = [f"{name}/{each}" for each in (names if full else names[:_SHORT])]
    if len(names) > len(lines):
        lines.append(f"... and {len(names) - len(lines)} more: sb3-belief envs list {name}")
    # Those of one group usually lack the same, and are told in one line
    groups: dict[tuple[str, str], list[str]] = {}
    for each, (modules, install) in lacking.items():
        if modules:
            groups.setdefault((" and ".join(modules), install), []).append(each)
    for (without, install), ids in groups.items():
        some = comma_separated([f"{name}/{one}" for one in ids], most=len(ids) if full else 2)
        lines.append(f"not installed: {some} (without {without}): {install}")
    return _block(f"{name}/<name>: {'partly installed' if groups else 'installed'}", lines)


def _block(title: str, lines: list[str]) -> str:
    return "\n  ".join([title, *lines])


def print_env_check(
    env_id: str, env_kwargs: list[str], n_steps: int = 500, seed: int = 0, extra_packages: tuple[str, ...] = ()
) -> bool:
    """
    Play an environment at random and print which requirements of a team it meets.

    :param env_id: Registered id, ``suite/name`` or ``module:callable``
    :param env_kwargs: ``key:value`` pairs of arguments of the environment
    :param n_steps: Number of steps to play
    :param seed: Seed of the environment
    :param extra_packages: See ``names.resolve``
    :return: Whether the environment meets all requirements
    :raises ConfigError: If there is no such environment
    """
    # Imported here, because listing environments does not need it
    from sb3_belief.envs.env_checker import check_team_env

    make_env = load_env(env_id, "envs check", extra_packages)
    location, n_leading = Location("--env-kwargs", extra_packages), len(get_env(env_id, "envs check").leading)
    given = check_call(make_env, parse_pairs(env_kwargs, "--env-kwargs"), location, skip=n_leading, of_env=True)
    try:
        report = check_team_env(env_id, given, n_steps, seed)
    except Exception as error:
        raise ConfigError(f"envs check: {cause(error)}") from error
    print(report)
    return not report.failures
