"""Pictures of a Traffic Junction that are drawn with pygame."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_belief.envs.pictures import import_pygame
from sb3_belief.envs.traffic_junction.core import BRAKE, TrafficCore
from sb3_belief.envs.traffic_junction.layout import Cell, Layout

WIDTH, HUD_HEIGHT = 608, 32
"""In pixels. The picture is WIDTH x (WIDTH + HUD_HEIGHT), multiples of 16 as video encoders require."""
_SCALE = 3
"""Everything is drawn larger by about this factor and then shrunk, which smooths all edges at once."""

_GRASS, _GRASS_DARK, _KERB, _ASPHALT = (122, 160, 92), (112, 150, 84), (196, 192, 180), (72, 75, 82)
_PAINT, _PAINT_DIM, _CENTRE = (232, 232, 226), (118, 121, 128), (228, 186, 76)
_HUD, _HUD_TEXT, _ALARM = (34, 37, 44), (236, 238, 240), (255, 92, 72)
_FLASH, _FLASH_CORE, _BRAKE_LIGHT, _GLASS = (240, 62, 44), (255, 206, 84), (255, 58, 48), (44, 56, 70)
_CARS = (
    (66, 135, 245), (240, 148, 52), (52, 178, 120), (214, 78, 96), (150, 106, 222),
    (222, 196, 62), (62, 188, 206), (232, 122, 188), (176, 126, 88), (236, 236, 232),
    (38, 92, 176), (188, 98, 26), (28, 124, 82), (156, 42, 62), (100, 66, 168),
    (160, 138, 30), (32, 126, 144), (172, 70, 132), (118, 80, 52), (158, 162, 168),
)  # fmt: skip


class Renderer:
    """
    Renderer of one copy of a junction: the road after the last step, and the cells where cars collided in that step.

    :param layout: The roads
    :param max_steps: Length of an episode in steps
    :raises ImportError: If pygame is not installed
    """

    def __init__(self, layout: Layout, max_steps: int):
        self.pygame = import_pygame()
        self.pygame.font.init()
        self.layout = layout
        self.max_steps = max_steps
        self.size = layout.level.size
        self._cell = WIDTH * _SCALE // self.size
        self._side = self.size * self._cell
        self._hud = round(HUD_HEIGHT * self._side / WIDTH)
        self._window: Any = None
        self._clock: Any = None
        self._fonts: dict[int, Any] = {}
        self._background = self._draw_roads()
        self._headings = _headings(layout)

    def image(self, core: TrafficCore, copy: int) -> np.ndarray:
        """
        Return a picture of one copy.

        :param core: The copies
        :param copy: Index of the copy
        :return: uint8 [height, width, 3]
        """
        surface = self._draw(core, copy)
        return np.ascontiguousarray(self.pygame.surfarray.array3d(surface).transpose(1, 0, 2))

    def show(self, core: TrafficCore, copy: int, fps: int) -> None:
        """
        Show one copy in a window, which is opened at the first call.

        :param core: The copies
        :param copy: Index of the copy
        :param fps: Largest number of pictures per second. The call waits as long as that requires
        """
        pygame = self.pygame
        surface = self._draw(core, copy)
        if self._window is None:
            pygame.display.init()
            self._window = pygame.display.set_mode(surface.get_size())
            pygame.display.set_caption("Traffic Junction")
            self._clock = pygame.time.Clock()
        self._window.blit(surface, (0, 0))
        # Without handling its events the system takes the window for one that hangs
        pygame.event.pump()
        pygame.display.flip()
        self._clock.tick(fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self.pygame.display.quit()
            self._window = None

    def _draw(self, core: TrafficCore, copy: int) -> Any:
        canvas = self._background.copy()
        crashed = [divmod(int(number), self.size) for number in np.flatnonzero(core.crashed[copy])]
        for cell in crashed:
            self._draw_flash(canvas, cell)
        sharing: dict[int, list[int]] = {}
        for slot in np.flatnonzero(core.on_road[copy]):
            sharing.setdefault(int(self.layout.cell[core.place[copy, slot]]), []).append(int(slot))
        for number, cars in sharing.items():
            for k, car in enumerate(cars):
                # Cars in one cell are drawn a little apart, so that all of them are visible
                shift = 0.28 * (k - (len(cars) - 1) / 2) * self._cell
                self._draw_car(canvas, core, copy, car, self._centre(divmod(number, self.size), shift))
        for cell in crashed:
            self._draw_ring(canvas, cell)
        self._draw_hud(canvas, core, copy)
        return self.pygame.transform.smoothscale(canvas, (WIDTH, WIDTH + HUD_HEIGHT))

    def _centre(self, cell: Cell, shift: float = 0.0) -> tuple[float, float]:
        row, column = cell
        x = (column + 0.5) * self._cell
        return x + shift, (row + 0.5) * self._cell + shift + self._hud

    def _box(self, cell: Cell) -> Any:
        row, column = cell
        return self.pygame.Rect(column * self._cell, row * self._cell + self._hud, self._cell, self._cell)

    # The road

    def _draw_roads(self) -> Any:
        pygame = self.pygame
        canvas = pygame.Surface((self._side, self._side + self._hud), 0, 32)
        canvas.fill(_GRASS)
        for row in range(self.size):
            for column in range(self.size):
                if (row + column) % 2:
                    canvas.fill(_GRASS_DARK, self._box((row, column)))
        kerb = max(2, self._cell // 9)
        for cell in self.layout.lanes:
            pygame.draw.rect(canvas, _KERB, self._box(cell).inflate(2 * kerb, 2 * kerb))
        for cell in self.layout.lanes:
            canvas.fill(_ASPHALT, self._box(cell))
        for cell in self.layout.lanes:
            self._draw_markings(canvas, cell)
        return canvas

    def _draw_markings(self, canvas: Any, cell: Cell) -> None:
        lanes = self.layout.lanes
        if len(lanes[cell]) > 1:
            return
        (down, right) = lanes[cell][0]
        before, after = (cell[0] - down, cell[1] - right), (cell[0] + down, cell[1] + right)
        # Traffic keeps to the right, so the oncoming lane is on the left: (down, right) turned by 90 degrees
        beside = (cell[0] - right, cell[1] + down)
        if lanes.get(beside) == ((-down, -right),):
            self._draw_line(canvas, cell, (0.36, 0.5), (-0.36, 0.5), (down, right), _CENTRE, 0.05)
        if len(lanes.get(after, ())) > 1:
            self._draw_line(canvas, cell, (0.44, 0.42), (0.44, -0.42), (down, right), _PAINT, 0.08)
        elif (cell[0] + cell[1]) % 2 == 0 and before in lanes and after in lanes:
            # An arrow on every other cell shows the direction of travel
            self._draw_line(canvas, cell, (-0.2, 0.0), (0.16, 0.0), (down, right), _PAINT_DIM, 0.06)
            tip = [self._point(cell, (down, right), *p) for p in ((0.3, 0.0), (0.1, 0.13), (0.1, -0.13))]
            self.pygame.draw.polygon(canvas, _PAINT_DIM, tip)

    def _point(self, cell: Cell, heading: Cell, ahead: float, left: float) -> tuple[float, float]:
        """Return the pixel coordinates of a point, given in cells ahead and to the left of a cell's centre for a driver."""
        x, y = self._centre(cell)
        down, right = heading
        return x + (ahead * right + left * down) * self._cell, y + (ahead * down - left * right) * self._cell

    def _draw_line(
        self,
        canvas: Any,
        cell: Cell,
        start: tuple[float, float],
        end: tuple[float, float],
        heading: Cell,
        colour: tuple[int, int, int],
        width: float,
    ) -> None:
        points = self._point(cell, heading, *start), self._point(cell, heading, *end)
        self.pygame.draw.line(canvas, colour, *points, max(1, round(width * self._cell)))

    # What moves

    def _draw_car(self, canvas: Any, core: TrafficCore, copy: int, car: int, centre: tuple[float, float]) -> None:
        pygame, place = self.pygame, int(core.place[copy, car])
        length, width = round(0.84 * self._cell), round(0.52 * self._cell)
        body = pygame.Surface((length, width), pygame.SRCALPHA, 32)
        colour = _CARS[car % len(_CARS)]
        dark = tuple(round(0.68 * c) for c in colour)
        corner = width // 3
        pygame.draw.rect(body, dark, (0, 0, length, width), border_radius=corner)
        edge = max(1, width // 14)
        pygame.draw.rect(body, colour, (edge, edge, length - 2 * edge, width - 2 * edge), border_radius=corner - edge)
        # The car is drawn facing right and then turned
        pygame.draw.rect(body, _GLASS, (0.7 * length, 0.16 * width, 0.13 * length, 0.68 * width), border_radius=corner // 2)
        pygame.draw.rect(body, _GLASS, (0.1 * length, 0.2 * width, 0.08 * length, 0.6 * width), border_radius=corner // 3)
        for side in (0.1, 0.72):
            pygame.draw.rect(body, (255, 244, 200), (0.93 * length, side * width, 0.06 * length, 0.18 * width))
            light = _BRAKE_LIGHT if core.last_action[copy, car] == BRAKE else (126, 34, 34)
            pygame.draw.rect(body, light, (0.01 * length, side * width, 0.07 * length, 0.18 * width))
        turned = pygame.transform.rotozoom(body, self._headings[place], 1.0)
        x, y = centre
        canvas.blit(turned, turned.get_rect(center=(round(x), round(y))))
        ink = (24, 26, 30) if sum(colour) > 480 else (255, 255, 255)
        label = self._font(round(0.4 * self._cell)).render(str(car), True, ink)
        canvas.blit(label, label.get_rect(center=(round(x), round(y))))

    def _draw_flash(self, canvas: Any, cell: Cell) -> None:
        x, y = self._centre(cell)
        for colour, outer, inner in ((_FLASH, 0.86, 0.5), (_FLASH_CORE, 0.66, 0.4)):
            points = []
            for k in range(24):
                radius = (outer if k % 2 == 0 else inner) * self._cell
                points.append((x + radius * math.sin(math.pi * k / 12), y - radius * math.cos(math.pi * k / 12)))
            self.pygame.draw.polygon(canvas, colour, points)

    def _draw_ring(self, canvas: Any, cell: Cell) -> None:
        x, y = self._centre(cell)
        self.pygame.draw.circle(canvas, _FLASH, (round(x), round(y)), round(0.92 * self._cell), max(2, self._cell // 14))

    def _draw_hud(self, canvas: Any, core: TrafficCore, copy: int) -> None:
        height, width = self._hud, self._side
        canvas.fill(_HUD, (0, 0, width, height))
        collisions = int(core.n_collisions[copy])
        texts = (
            (f"step {int(core.time[copy])} / {self.max_steps}", _HUD_TEXT),
            (f"arrival rate {core.arrival_rate:.3g}", _HUD_TEXT),
            (f"cars {int(core.on_road[copy].sum())} / {core.n_cars}", _HUD_TEXT),
            (f"collisions {collisions}", _ALARM if collisions else _HUD_TEXT),
        )
        for k, (text, colour) in enumerate(texts):
            label = self._font(round(0.5 * height)).render(text, True, colour)
            canvas.blit(label, label.get_rect(midleft=(round((k + 0.08) * width / len(texts)), height // 2)))

    def _font(self, size: int) -> Any:
        if size not in self._fonts:
            # The font that pygame ships makes the picture independent of the fonts of the system
            self._fonts[size] = self.pygame.font.Font(None, round(1.3 * size))
        return self._fonts[size]


def positions_in_picture(core: TrafficCore, copy: int, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """
    Return where the cars are in the picture of one copy.

    :param core: The copies
    :param copy: Index of the copy
    :param names: Names of the slots
    :return: {name: (x, y)} of the slots with a car, as fractions of the picture's width and height, from the upper left corner
    """
    size, height = core.layout.level.size, WIDTH + HUD_HEIGHT
    found = {}
    for slot in np.flatnonzero(core.on_road[copy]):
        row, column = divmod(int(core.layout.cell[core.place[copy, slot]]), size)
        found[names[int(slot)]] = (column + 0.5) / size, (HUD_HEIGHT + (row + 0.5) * WIDTH / size) / height
    return found


def _headings(layout: Layout) -> np.ndarray:
    """
    Return the direction that a car faces at each place.

    :param layout: The roads
    :return: Angles in degrees, [n_places], 0 to the right and 90 up. In a cell where a route turns it is halfway between the
        two directions
    """
    angles = np.zeros(len(layout.cell))
    for r, path in enumerate(layout.routes):
        for k in range(len(path)):
            before, after = path[max(k - 1, 0)], path[min(k + 1, len(path) - 1)]
            angles[r * layout.stride + k] = math.degrees(math.atan2(before[0] - after[0], after[1] - before[1]))
    return angles
