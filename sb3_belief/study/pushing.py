"""What is sent to a hub of a run of a study: the run, and the score of its final episodes."""

from pathlib import Path

from sb3_belief.study.cell_record import CELL_RECORD, FINISHED, Cell
from sb3_belief.zoo.errors import ConfigError
from sb3_belief.zoo.run_folder import BEST_MODEL, TEAM
from sb3_belief.zoo.run_score import RunScore, score_of_episodes


def run_to_push(folder: str) -> tuple[Path, tuple[RunScore, ...]]:
    """
    Return the run that a folder means, and the scores of its final episodes if it is that of a study's cell.

    :param folder: Folder of a run, which may lie in that of a cell, or of a cell itself
    :return: Folder of the run, and the scores of its teams, the best one first. None if the cell has not finished
    :raises ConfigError: If the cell has no run, or if its record or its episodes cannot be read
    """
    given = Path(folder)
    if (given / CELL_RECORD).is_file():
        cell = Cell(given)
        run = cell.run_folder(cell.read())
        if run is None:
            raise ConfigError(f"push: {folder!r} is the folder of a cell whose run has not begun: sb3-belief study runs it.")
        return run, _final_scores(cell, run)
    cell = Cell(given.absolute().parent.parent)
    return given, _final_scores(cell, given) if cell.path.is_file() else ()


def _final_scores(cell: Cell, run: Path) -> tuple[RunScore, ...]:
    record = cell.read()
    newest = cell.run_folder(record)
    if record["status"] != FINISHED or newest is None or newest.resolve() != run.resolve():
        return ()
    try:
        from sb3_belief.report.episodes import episodes_of, read_episodes_table

        table = read_episodes_table(cell.episodes)
    except (ImportError, OSError, ValueError) as error:
        raise ConfigError(f"push: {error}") from None
    found = []
    for checkpoint, file in (("best", BEST_MODEL), ("last", TEAM)):
        # Where no evaluation was, the last episodes of the training count, whose actions were sampled
        for deterministic in (True, False):
            played = episodes_of(table, checkpoint, deterministic)
            if played.num_rows and (run / file).is_file():
                successes = None if played["success"].null_count else played["success"].to_numpy()
                steps, returns = played["joint_steps"][0].as_py(), played["episode_return"].to_numpy()
                found.append(score_of_episodes(steps, returns, successes, file, deterministic))
                break
    return tuple(found)
