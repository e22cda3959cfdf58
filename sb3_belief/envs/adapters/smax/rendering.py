"""Pictures of SMAX's battles."""

import numpy as np

from sb3_belief.envs.adapters.smax.core import Battles

_ALLY, _ENEMY = "tab:blue", "tab:red"


def draw(battles: Battles, copy: int) -> np.ndarray:
    """
    :param battles: the copies
    :param copy: which one
    :return: the living units as discs with their type's letter, allies blue, enemies red, paler with less health; uint8
        [height, width, 3]
    """
    # The figure is drawn without pyplot, which would want a display or keep it open
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    look = battles.look
    units = battles.units(copy)
    figure = Figure(figsize=(4, 4), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), aspect="equal", xticks=[], yticks=[])
    axes.set_xlim(0, look.map_size[0])
    axes.set_ylim(0, look.map_size[1])
    for i in np.flatnonzero(units["alive"]):
        x, y = units["positions"][i]
        kind = int(units["types"][i])
        share = units["health"][i] / look.full_health[kind]
        colour = _ALLY if i < len(battles.agents) else _ENEMY
        axes.add_patch(Circle((x, y), float(look.radii[kind]), facecolor=colour, edgecolor=colour, alpha=0.3 + 0.7 * share))
        axes.text(x, y, look.letters[kind], ha="center", va="center", fontsize=6)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
