"""Pictures of games on a grid, drawn with pygame. They need no display."""

from typing import Any

import numpy as np

Colour = tuple[int, int, int]

#: Side of a picture in pixels, as far as whole cells allow it
SIDE = 480
GROUND, LINE, INK, PAPER = (244, 244, 240), (206, 206, 200), (34, 37, 44), (255, 255, 255)
#: Colours of agents, which repeat
AGENT_COLOURS: tuple[Colour, ...] = (
    (66, 135, 245), (240, 148, 52), (52, 178, 120), (214, 78, 96),
    (150, 106, 222), (62, 188, 206), (232, 122, 188), (176, 126, 88),
)  # fmt: skip


def import_pygame() -> Any:
    """
    Import pygame.

    :return: The module
    :raises ImportError: If it is not installed. The message has the line that installs it
    """
    try:
        import pygame
    except ImportError as error:
        raise ImportError('Rendering needs pygame: pip install "sb3-belief[plots]"') from error
    return pygame


def cell_position(row: int, column: int, rows: int, columns: int) -> tuple[float, float]:
    """
    Return where the middle of a cell is in the picture of a grid.

    :param row: Row of the cell, from the top
    :param column: Column of the cell, from the left
    :param rows: Number of rows
    :param columns: Number of columns
    :return: (x, y) as fractions of the picture's width and height, from the upper left corner
    """
    return (column + 0.5) / columns, (row + 0.5) / rows


class GridPicture:
    """
    Picture of a grid of square cells.

    :param rows: Number of rows
    :param columns: Number of columns
    :raises ImportError: If pygame is not installed
    """

    def __init__(self, rows: int, columns: int):
        self._pygame = import_pygame()
        self._pygame.font.init()
        # Even, so that a picture has the even sides that video encoders require
        self._cell = max(2 * (SIDE // (2 * max(rows, columns))), 8)
        self._canvas = self._pygame.Surface((columns * self._cell, rows * self._cell), 0, 32)
        self._canvas.fill(GROUND)
        for row in range(rows):
            for column in range(columns):
                self._pygame.draw.rect(self._canvas, LINE, self._box(row, column), 1)

    def square(self, row: int, column: int, colour: Colour, text: str = "", size: float = 1.0) -> None:
        """
        Draw a square in the middle of a cell.

        :param row: Row of the cell, from the top
        :param column: Column of the cell, from the left
        :param colour: RGB
        :param text: What is written on it
        :param size: Its side as a fraction of the cell's, in (0, 1]
        """
        box = self._box(row, column)
        self._pygame.draw.rect(self._canvas, colour, box.inflate(*(round((size - 1) * self._cell),) * 2))
        self._write(box.center, text, colour)

    def disc(self, row: int, column: int, colour: Colour, text: str = "", heading: tuple[int, int] | None = None) -> None:
        """
        Draw a disc in a cell.

        :param row: Row of the cell, from the top
        :param column: Column of the cell, from the left
        :param colour: RGB
        :param text: What is written on it
        :param heading: Step (rows, columns) to which a line from the centre points, or None for no line
        """
        x, y = self._box(row, column).center
        radius = round(0.38 * self._cell)
        if heading is not None:
            end = (x + round(0.48 * heading[1] * self._cell), y + round(0.48 * heading[0] * self._cell))
            self._pygame.draw.line(self._canvas, INK, (x, y), end, max(2, self._cell // 8))
        self._pygame.draw.circle(self._canvas, colour, (x, y), radius)
        self._write((x, y), text, colour)

    def image(self) -> np.ndarray:
        """
        Return the picture.

        :return: uint8 [height, width, 3]
        """
        return np.ascontiguousarray(self._pygame.surfarray.array3d(self._canvas).transpose(1, 0, 2))

    def _box(self, row: int, column: int) -> Any:
        return self._pygame.Rect(column * self._cell, row * self._cell, self._cell, self._cell)

    def _write(self, centre: tuple[int, int], text: str, colour: Colour) -> None:
        if text:
            # The font that pygame ships makes the picture independent of the fonts of the system
            font = self._pygame.font.Font(None, max(round(0.6 * self._cell / max(1, len(text) / 3)), 10))
            label = font.render(text, True, INK if sum(colour) > 480 else PAPER)
            self._canvas.blit(label, label.get_rect(center=centre))
