"""One run of a soak: it is disturbed, again and again, and what must hold is checked after each fault and at the end."""

import random
import shutil
import signal
import time
from pathlib import Path
from typing import Any

from sb3_belief.team import Team
from sb3_belief.zoo.run_folder import find_team
from tests.reliability.combinations import BELIEF, OTHERS, Combination, check_equal_to
from tests.reliability.kills import PATIENCE, has_begun, has_checkpoint, run_in
from tests.reliability.processes import Launcher, Training, wait_for
from tests.reliability.soak.faults import Fault, damage_newest, death_of_a_worker, full_disk, ordered, signals
from tests.reliability.soak.report import Report
from tests.zoo.runs import record_of, table

_OWN = "tests.reliability.ordered_env:make"
_SETTINGS = ("n_envs:2", "n_steps:40", "batch_size:40", "n_epochs:2", "policy_kwargs.net_arch:[16,16]")


def own_combinations(orders: Path) -> dict[str, Combination]:
    """Return the runs in an environment that does what a file says, which copies in evaluations do not look for."""
    own = ("--allow-package", "tests", "--env-kwargs", f"orders:{orders}", "--eval-env-kwargs", "orders:null")
    subproc = (*own, "--vec-env", "subproc", "--step-timeout", "10")
    return {
        "own, dummy, 1 job": Combination("ppo", _OWN, 8000, 400, _SETTINGS, own),
        "own, subproc, 1 job": Combination("ppo", _OWN, 4000, 160, _SETTINGS, subproc),
        "own, subproc, 2 jobs, normalize": Combination(
            "belief_ppo", _OWN, 1600, 80, (*_SETTINGS, "history_length:40", "normalize:true"), (*subproc, "--jobs", "2")
        ),
        "own, subproc, restarts": Combination("ppo", _OWN, 4000, 160, _SETTINGS, (*subproc, "--restart-workers", "100")),
    }


class Soak:
    """
    Runs with faults.

    :param launcher: Starts trainings
    :param folder: Folder of all that is written
    :param disk: Folder on a small file system of its own; None if there is none
    :param rng: Draws everything
    :param report: Counts
    """

    def __init__(self, launcher: Launcher, folder: Path, disk: Path | None, rng: random.Random, report: Report):
        self._launcher, self._folder, self._disk, self._rng, self._report = launcher, folder, disk, rng, report
        self._orders = folder / "orders"
        self._combinations = {**BELIEF, **OTHERS, **own_combinations(self._orders)}
        self._waiting: list[str] = []
        self._twins: dict[str, tuple[Path, float]] = {}

    def run_one(self) -> None:
        """Draw a kind of run, disturb it until it has finished, and compare it with its undisturbed twin."""
        if not self._waiting:
            self._waiting = self._rng.sample(sorted(self._combinations), len(self._combinations))
        name = self._waiting.pop()
        combination = self._combinations[name]
        if name not in self._twins:
            self._twins[name] = self._train_twin(name, combination)
        twin, seconds = self._twins[name]
        self._report.runs += 1
        on_disk = self._disk is not None and self._rng.random() < 0.3
        base = self._disk if on_disk and self._disk is not None else self._folder
        run = _Run(self, name, combination, base / f"run_{self._report.runs}", seconds, on_disk)
        before = len(self._report.violations)
        try:
            run.disturb(self._rng.randint(1, 4))
            run.finish(twin)
        # Whatever is found goes into the report, and the soak goes on
        except AssertionError as error:
            self._report.check("the run goes on to its end", False, f"{name}: {error}")
        finally:
            self._orders.unlink(missing_ok=True)
            kept = self._folder / "violations" / f"run_{self._report.runs}"
            if len(self._report.violations) > before and run.folder.exists():
                shutil.copytree(run.folder, kept, dirs_exist_ok=True)
            shutil.rmtree(run.folder, ignore_errors=True)

    def _train_twin(self, name: str, combination: Combination) -> tuple[Path, float]:
        folder = self._folder / "twins" / "".join(c if c.isalnum() else "_" for c in name)
        training = self._launcher.start(combination.command(folder, self._report.seed))
        wait_for(lambda: has_begun(training, folder), PATIENCE)
        start = time.monotonic()
        assert training.wait(PATIENCE) == 0, training.output
        run = run_in(folder)
        assert run is not None
        return run, time.monotonic() - start

    def faults_for(self, name: str, combination: Combination, on_disk: bool) -> list[Fault]:
        """Return the faults that can befall a run."""
        rng, words = self._rng, combination.words
        found = signals()
        subproc, jobs = "subproc" in words, "--jobs" in words
        restarts = "--restart-workers" in words
        if jobs or subproc:
            what = "a worker" if jobs and subproc else "a learning worker" if jobs else "an environment's worker"
            if not restarts:
                found.append(death_of_a_worker(rng, what))
        if combination.env == _OWN:
            found.append(ordered("raise", self._orders, "error in an environment", restarts))
            if subproc:
                found.append(ordered("die", self._orders, "death in a step", restarts))
                found.append(ordered("hang", self._orders, "hang in a step", restarts))
        if on_disk and self._disk is not None:
            found += 3 * [full_disk(self._disk, rng)]
        return found

    def draw(self, faults: list[Fault]) -> Fault:
        """Draw one, mostly of those that not every run can have, and half the time of those that came least."""
        signals_only = {fault.name for fault in signals()}
        special = [fault for fault in faults if fault.name not in signals_only]
        if special and self._rng.random() < 0.6:
            faults = special
        least = min(self._report.faults[fault.name] for fault in faults)
        rare = [fault for fault in faults if self._report.faults[fault.name] == least]
        return self._rng.choice(rare if self._rng.random() < 0.5 else faults)


class _Run:
    def __init__(self, soak: Soak, name: str, combination: Combination, folder: Path, seconds: float, on_disk: bool):
        self._soak, self._name, self._combination, self.folder = soak, name, combination, folder
        self._seconds, self._on_disk = seconds, on_disk
        self._report, self._rng = soak._report, soak._rng
        self._is_cut = False
        self._damaged: Path | None = None
        self._history: list[str] = []

    @property
    def _run(self) -> Path:
        run = run_in(self.folder)
        assert run is not None, f"{self._name}: there is no run"
        return run

    def _check(self, invariant: str, holds: Any, detail: str) -> bool:
        return self._report.check(invariant, holds, f"{self._name} ({'; '.join(self._history)}): {detail}")

    def disturb(self, count: int) -> None:
        """Begin, and inject faults until there were enough of them or the run has finished."""
        faults = self._soak.faults_for(self._name, self._combination, self._on_disk)
        for _ in range(count):
            fault = self._soak.draw(faults)
            self._history.append(fault.name)
            if not self._leg(fault):
                return
            if not has_checkpoint(self.folder):
                # On a full disk there may be none
                return
            if self._rng.random() < 0.3 and self._damaged is None:
                damaged = damage_newest(self._run / "checkpoints", self._rng)
                if damaged is not None:
                    kind, self._damaged = damaged
                    self._history.append(kind)
                    self._report.faults[kind] += 1

    def _start(self) -> Training:
        if has_checkpoint(self.folder):
            words = ["train", "--resume", str(self._run), "--verbose", "0", *self._combination.allowed]
        else:
            shutil.rmtree(self.folder, ignore_errors=True)
            words = self._combination.command(self.folder, self._report.seed)
        # Some as a user starts them; their workers are not known
        anew = self._rng.random() < 0.1 and not set(self._combination.words) & {"subproc", "--jobs"}
        return self._soak._launcher.start(words, anew)

    def _leg(self, fault: Fault) -> bool:
        """Run until a fault has ended the training; return False if there is nothing more to disturb."""
        before = record_of(self._run) if has_checkpoint(self.folder) else None
        training = self._start()
        wait_for(lambda: has_begun(training, self.folder), PATIENCE)
        if fault.record in ("failed", "finished"):
            # A run that has not begun to go on refuses what fails then
            wait_for(lambda: training.poll() is not None or self._goes_on(before) or None, PATIENCE)
        time.sleep(self._rng.uniform(0.0, 0.6) * self._seconds)
        came = fault.inject(training, self._run)
        status = training.wait(PATIENCE)
        if not self._check("trainings end", status is not None, f"it hangs: {training.output}"):
            training.send(signal.SIGKILL)
            training.wait(20)
        if self._on_disk and self._soak._disk is not None:
            (self._soak._disk / "filler").unlink(missing_ok=True)
        if came:
            self._report.faults[fault.name] += 1
        else:
            self._report.notes["faults that came too late"] += 1
        self._check_damaged(training)
        self._check_end(fault, came, before, training, status)
        self._check("no process is left", training.has_left_none(), f"{training.descendants()}")
        self._is_cut = self._is_cut or (came and fault.cuts)
        return record_of(self._run)["status"] != "finished"

    def _goes_on(self, before: dict[str, Any] | None) -> bool:
        now = record_of(self._run)
        return now["status"] == "running" and (before is None or len(now.get("resumed", [])) > len(before.get("resumed", [])))

    def _check_damaged(self, training: Training) -> None:
        """Check that a damaged checkpoint was not taken."""
        # A killed process may not have come to it, but then the next one does
        if self._damaged is None:
            return
        said = any(f"{self._damaged} {text}" in training.output for text in ("is damaged", "cannot be loaded"))
        if said or training.poll() == 0:
            self._check("damaged checkpoints are refused", said, f"{self._damaged}: {training.output}")
            self._damaged = None

    def _check_end(
        self, fault: Fault, came: bool, before: dict[str, Any] | None, training: Training, status: int | None
    ) -> None:
        record = record_of(self._run)
        now, detail = record["status"], f"exit status {status}, {record['status']}: {training.output[-1500:]}"
        if fault.name.startswith("full disk"):
            # Nothing could be written: the record may be that of before
            self._check("exit status", status in (0, 1), detail)
            self._check("true status", status == 1 or now in ("finished", "running"), detail)
        elif now == "finished" and not fault.cuts:
            # It had all but ended, or had just done so
            late = {0} | {each for code in fault.statuses for each in (code, 128 - code)}
            self._check("exit status", status in late, detail)
        else:
            self._check("exit status", status in (fault.statuses if came else {0}), detail)
            unchanged = before is not None and record == before
            at_once = ", three times" in fault.name and now == "running"
            self._check("true status", now == fault.record or unchanged or at_once, detail)
            if now == "interrupted" and not unchanged:
                self._check("true status", record["signal"] in fault.name, detail)
        self._check_team(record, detail)
        if status is not None and status >= 0 and ", three times" not in fault.name:
            left = list(self.folder.rglob("*.tmp"))
            self._check("no temporary file is left", not left, f"{left}, {detail}")

    def _check_team(self, record: dict[str, Any], detail: str) -> None:
        """Check that what a user would take for the team loads, and that it is what the record says."""
        try:
            team = Path(record["saved"]) if "saved" in record else find_team(self._run, "soak")
            steps = Team.load(team, device="cpu").num_timesteps
        # Whatever it is, it is what is looked for
        except Exception as error:
            self._check("the team loads", False, f"{error!r}, {detail}")
            return
        # Where the disk was full, the record and the team may be those of before
        self._check("the team loads", steps == record.get("timesteps", steps) or self._on_disk, f"{steps} steps, {detail}")

    def finish(self, twin: Path) -> None:
        """Go on to the end, and compare."""
        saved = record_of(self._run).get("saved") if has_checkpoint(self.folder) else None
        while not has_checkpoint(self.folder) or record_of(self._run)["status"] != "finished":
            training = self._start()
            status = training.wait(PATIENCE)
            if status is None:
                training.send(signal.SIGKILL)
            self._check_damaged(training)
            if not self._check("the run goes on to its end", status == 0, f"exit status {status}: {training.output}"):
                return
            self._check("no process is left", training.has_left_none(), f"{training.descendants()}")
            saved = record_of(self._run).get("saved")
        if saved is not None:
            shutil.move(saved, self._run / "team.zip")
        if self._is_cut:
            rows = table(self._run / "progress.csv")
            restarts = max(float(row["rollout/worker_restarts"] or 0) for row in rows if "rollout/worker_restarts" in row)
            self._check("restarts are logged", restarts > 0, f"{restarts}")
            return
        try:
            check_equal_to(self._run, twin)
        except AssertionError as error:
            self._check("equal to the undisturbed twin", False, str(error)[:3000])
        else:
            self._check("equal to the undisturbed twin", True, "")
