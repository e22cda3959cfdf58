"""Pictures of SMAX battles that are drawn with matplotlib."""

import numpy as np

from sb3_belief.envs.adapters.smax.core import Battles

_ALLY, _ENEMY = "tab:blue", "tab:red"


def draw(battles: Battles, copy: int) -> np.ndarray:
    """
    Draw one copy of a battle.

    Living units are discs with the letter of their type, blue for allies and red for enemies. They are paler with less health.

    :param battles: The copies
    :param copy: Index of the copy
    :return: uint8 [height, width, 3]
    """
    # Drawn without pyplot, which may require a display and keeps every figure in memory until it is closed
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    drawing = battles.drawing
    units = battles.units(copy)
    figure = Figure(figsize=(4, 4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), aspect="equal", xticks=[], yticks=[])
    axes.set_xlim(0, drawing.map_size[0])
    axes.set_ylim(0, drawing.map_size[1])
    for i in np.flatnonzero(units["alive"]):
        x, y = units["positions"][i]
        kind = int(units["types"][i])
        share = units["health"][i] / drawing.full_health[kind]
        colour = _ALLY if i < len(battles.agents) else _ENEMY
        axes.add_patch(Circle((x, y), float(drawing.radii[kind]), facecolor=colour, edgecolor=colour, alpha=0.3 + 0.7 * share))
        axes.text(x, y, drawing.letters[kind], ha="center", va="center", fontsize=6)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def unit_positions(battles: Battles, copy: int) -> dict[str, tuple[float, float]]:
    """
    Return where the living allies are in the picture of one copy.

    :param battles: The copies
    :param copy: Index of the copy
    :return: {agent: (x, y)} as fractions of the picture's width and height, from the upper left corner
    """
    units, (width, height) = battles.units(copy), battles.drawing.map_size
    side = max(width, height)
    return {
        agent: (0.5 + float(x - width / 2) / side, 0.5 - float(y - height / 2) / side)
        for agent, (x, y), alive in zip(battles.agents, units["positions"], units["alive"], strict=False)
        if alive
    }
