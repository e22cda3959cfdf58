"""Teams on the Hugging Face hub: sent there with a card, and taken from there only if they load as plain data."""

import io
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sb3_belief.common.exceptions import first_line
from sb3_belief.report.evaluations import EVALUATIONS
from sb3_belief.team import Team
from sb3_belief.zoo.errors import ConfigError, RunFailed, cause, reason_of, short
from sb3_belief.zoo.model_card import CardContent, model_card
from sb3_belief.zoo.preflight import check_folder
from sb3_belief.zoo.run_folder import BEST_MODEL, CONFIG, RECORD, TEAM, find_team, read_record, run_of_record
from sb3_belief.zoo.run_score import RunScore, run_scores
from sb3_belief.zoo.yaml_data import read_file

CARD = "README.md"
#: All that a repository of a team holds, and all that is taken from one
FILES = (TEAM, BEST_MODEL, CONFIG, RECORD, EVALUATIONS, CARD)
# Entries of a record that tell of the machine of whoever trained, and that nobody else can use
_OWN = ("command", "source", "trained_agent", "saved", "error", "resumed", "tracking")
_OWN_OPTIONS = ("log_folder", "tensorboard_log", "trained_agent", "track", "track_project")


@dataclass(frozen=True)
class PushOptions:
    """
    What is to be sent where.

    :param run: Folder of the run
    :param repo_id: Repository, ``owner/name``; it is made if it does not exist
    :param private: Whether a new repository is private
    :param message: Message of the commit
    :param extra_packages: See ``Team.load`` (``allow_packages``)
    :param final_scores: Scores of episodes after the training; that of the best team first. None for those of the run's
        evaluations
    """

    run: str
    repo_id: str
    private: bool = False
    message: str = "Add a team"
    extra_packages: tuple[str, ...] = ()
    final_scores: tuple[RunScore, ...] = ()


def push_team(options: PushOptions) -> str:
    """
    Send a run's team to the Hugging Face hub, with its configuration, its evaluations and a card.

    :param options: What is to be sent where
    :return: Address of the repository
    :raises ConfigError: If there is no such run, or if its team would not load elsewhere. Nothing has been sent then
    :raises RunFailed: If the hub refuses it, or cannot be reached
    """
    _check_hub("push", options.repo_id)
    folder = Path(options.run)
    if not (folder / RECORD).is_file():
        raise ConfigError(f"push: {str(folder)!r} is not the folder of a run: it has no {RECORD}.")
    record = read_record(folder)
    run = run_of_record(folder, record)
    if run is None:
        raise ConfigError(f"push: no {CONFIG} in {str(folder)!r}.")
    path = find_team(folder, "push")
    team = _load_untrusted(path, options.extra_packages, "push")
    best = folder / BEST_MODEL
    if best.is_file():
        _load_untrusted(best, options.extra_packages, "push")
    card = CardContent(
        options.repo_id,
        record,
        read_file(folder / CONFIG).get(record["env"]) or {},
        {agent: type(model).__name__ for agent, model in team.agents.items()},
        team.num_timesteps,
        options.final_scores or run_scores(folder) or (),
        best.is_file(),
        (folder / EVALUATIONS).is_file(),
        is_final=bool(options.final_scores),
    )
    files: dict[str, Any] = {
        TEAM: path,
        CONFIG: folder / CONFIG,
        RECORD: (json.dumps(_for_others(record), indent=2) + "\n").encode(),
        CARD: model_card(card).encode(),
    }
    files.update({name: folder / name for name in (BEST_MODEL, EVALUATIONS) if (folder / name).is_file()})

    from huggingface_hub import CommitOperationAdd, HfApi

    api = HfApi()
    with _refusals("push", options.repo_id):
        url = api.create_repo(options.repo_id, private=options.private or None, exist_ok=True)
        contents = {name: io.BytesIO(each) if isinstance(each, bytes) else str(each) for name, each in files.items()}
        operations = [CommitOperationAdd(name, content) for name, content in contents.items()]
        api.create_commit(options.repo_id, operations, commit_message=options.message)
    print(f"Sent {', '.join(files)} to {url}")
    return str(url)


@dataclass(frozen=True)
class PullOptions:
    """
    What is to be taken from where.

    :param repo_id: Repository, ``owner/name``
    :param output: Folder to make; None for ``logs/hub/<owner>/<name>``
    :param revision: Branch, tag or commit; None for the newest state
    :param extra_packages: See ``Team.load`` (``allow_packages``)
    """

    repo_id: str
    output: str | None = None
    revision: str | None = None
    extra_packages: tuple[str, ...] = ()


def pull_team(options: PullOptions) -> Path:
    """
    Take a team from the Hugging Face hub into a new folder, if it loads as plain data.

    Only files of known names are taken. They come into a folder of another name, which is given its name once the team has
    been loaded, so that whatever fails leaves nothing behind.

    :param options: What is to be taken from where
    :return: The folder, with which ``enjoy`` does what it does with a run's
    :raises ConfigError: If the repository has no team, or one that does not load without trust
    :raises RunFailed: If the hub cannot be reached
    """
    _check_hub("load", options.repo_id)
    folder = Path(options.output or Path("logs", "hub", *options.repo_id.split("/")))
    if folder.exists():
        raise ConfigError(f"-o: {str(folder)!r} exists already: name a new folder.")
    check_folder(folder, "-o")

    from huggingface_hub import snapshot_download

    existing = next(each for each in folder.absolute().parents if each.is_dir())
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name[:40]}.", dir=folder.parent) as temporary:
            taken = Path(temporary, "taken")
            with _refusals("load", options.repo_id):
                snapshot_download(options.repo_id, revision=options.revision, allow_patterns=list(FILES), local_dir=taken)
            shutil.rmtree(taken / ".cache", ignore_errors=True)
            _check_taken(taken, options)
            taken.replace(folder)
    except OSError as error:
        raise RunFailed(f"load: {str(folder)!r} could not be written ({reason_of(error)}).") from error
    finally:
        _remove_empty(folder.absolute().parent, existing)
    print(f"Took {options.repo_id} to {folder}. To see it play: sb3-belief enjoy {folder}")
    return folder


def _check_hub(command: str, repo_id: str) -> None:
    for package in ("huggingface_hub", "scipy") if command == "push" else ("huggingface_hub",):
        if find_spec(package) is None:
            raise ConfigError(f"{command}: the hub needs {package}: pip install 'sb3-belief[hub]'.")
    name = r"[\w][\w.-]{0,95}"
    if not re.fullmatch(f"{name}/{name}", repo_id, re.ASCII) or "--" in repo_id or ".." in repo_id:
        raise ConfigError(f"{command}: {short(repo_id)} is no name of a repository: give owner and name, as in me/my-team.")


def _check_taken(folder: Path, options: PullOptions) -> None:
    """Check that files of a stranger are a team, and data."""
    if not (folder / TEAM).is_file():
        raise ConfigError(f"load: {options.repo_id} has no {TEAM}: it holds no team of sb3-belief.")
    for name in (TEAM, BEST_MODEL):
        if (folder / name).is_file():
            _load_untrusted(folder / name, options.extra_packages, f"load: {options.repo_id}")
    if (folder / RECORD).is_file():
        run_of_record(folder, read_record(folder))
    if (folder / CONFIG).is_file():
        read_file(folder / CONFIG)


def _load_untrusted(path: Path, extra_packages: tuple[str, ...], where: str) -> Team:
    try:
        return Team.load(path, device="cpu", allow_packages=extra_packages)
    # A damaged file makes zipfile, json and torch raise whatever they raise
    except Exception as error:
        raise ConfigError(f"{where}: {path.name} does not load as plain data, and is refused: {cause(error)}") from error


def _for_others(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without what tells of the machine of whoever trained."""
    kept = {key: value for key, value in record.items() if key not in _OWN}
    options = kept.get("options")
    if isinstance(options, dict):
        kept["options"] = {key: value for key, value in options.items() if key not in _OWN_OPTIONS}
    return kept


@contextmanager
def _refusals(command: str, repo_id: str) -> Iterator[None]:
    """Say in one line what the hub refuses."""
    from huggingface_hub import errors

    try:
        yield
    except (errors.RepositoryNotFoundError, errors.GatedRepoError) as error:
        raise ConfigError(
            f"{command}: the hub shows no repository {repo_id} ({first_line(error)}). A private one, or a gated one, needs a"
            " token: hf auth login, or HF_TOKEN."
        ) from error
    except errors.RevisionNotFoundError as error:
        raise ConfigError(f"{command}: {repo_id} has no such revision ({first_line(error)}).") from error
    except errors.HfHubHTTPError as error:
        status = getattr(error.response, "status_code", None)
        token = " A token with the right to write: hf auth login, or HF_TOKEN." if status in (401, 403) else ""
        raise RunFailed(f"{command}: the hub has refused it ({first_line(error)}).{token}") from error
    except ConfigError:
        raise
    # Whatever a network, and the package that speaks with it, fails with
    except Exception as error:
        raise RunFailed(f"{command}: the hub cannot be reached, or answers something else: {cause(error)}") from error


def _remove_empty(folder: Path, until: Path) -> None:
    """Remove folders that were made, if nothing came into them."""
    try:
        while folder != until:
            os.rmdir(folder)
            folder = folder.parent
    except OSError:
        pass
