# SPDX-License-Identifier: Apache-2.0
"""The simulation in the page's own process, and its controls; it needs no ROS."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spinning_top_sim.installation import parameter_files
from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.physics.states import States
from spinning_top_sim.physics.top import State, Top
from spinning_top_sim.recording.errors import text_of
from spinning_top_sim.solvers.dormand_prince import IntegrationError
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NANOSECONDS, Times
from spinning_top_sim.tools.scene_file import read_scene
from spinning_top_sim.view.page import Page, set_value
from spinning_top_sim.view.player import Player
from spinning_top_sim.view.source import WINDOW_NS, Track

PERIOD_NS = 10_000_000          # between the points of a trace
FILE_S = 20.0                   # length of a file, where `duration` is 0
STEPS = 1000                    # of a slider
# Name, unit and meaning of each slider.
SLIDERS = (
    ('mass M', 'kg', 'mass of the top'),
    ('length R', 'm', 'from the pivot to the centre of mass, along the axis'),
    ('moment λ₁', 'kg m²', 'principal moment of inertia across the axis, about the pivot'),
    ('moment λ₃', 'kg m²', 'principal moment of inertia along the axis'),
    ('tilt θ', 'deg', 'from the upward vertical, at the start'),
    ('spin ψ′', 'rad/s', 'about the axis, at the start'),
    ('precession φ′', 'rad/s', 'about the vertical, at the start'))
# A scene sets these groups of parameters.
GROUPS = ('top.', 'initial.', 'spin.', 'pivot.')


def numbers_of(values: Mapping[str, Any]) -> list[float]:
    """Return the numbers of SLIDERS that parameters describe."""
    top, start = parameters.top_of(values), parameters.start_state(values)
    precession = 0.0
    if 0.0 < start.theta < math.pi:
        precession = float(attitude.precession_rate(
            top, start.l3, start.lz, math.cos(0.5 * start.theta) ** 2,
            math.sin(0.5 * start.theta) ** 2))
    return [top.mass, top.com_distance, top.lambda1, top.lambda3, math.degrees(start.theta),
            start.l3 / top.lambda3 - precession * math.cos(start.theta), precession]


def with_numbers(values: Mapping[str, Any], numbers: Sequence[float]) -> dict[str, Any]:
    """Return checked parameters with these numbers of SLIDERS.  Raises ValueError."""
    mass, length, lambda1, lambda3, tilt, spin, precession = numbers
    top = Top(lambda1=lambda1, lambda3=lambda3, mass=mass, com_distance=length,
              gravity=values['top.gravity'])
    start = State.from_rates(math.radians(tilt), precession, values['initial.theta_dot'], spin,
                             top=top)
    return parameters.checked({
        **values, 'top.mass': mass, 'top.com_distance': length, 'top.lambda1': lambda1,
        'top.lambda3': lambda3, 'initial.theta': start.theta, 'spin.l3': start.l3,
        'spin.lz': start.lz})


def ranges(numbers: Sequence[float], natural: float) -> list[tuple[float, float]]:
    """Return the ends of each slider; `natural` is sqrt(lambda1 |P|) [kg m^2/s]."""
    def reach(*sizes: float) -> float:
        return float(f'{3.0 * max(map(abs, sizes)):.0e}')       # of one digit
    mass, length, lambda1, lambda3, _, spin, precession = numbers
    far = reach(length) or 0.2
    fast = reach(spin, natural / lambda3) or 10.0
    slow = reach(precession, natural / lambda1) or 10.0
    return [(0.0, reach(mass) or 1.0), (-far, far), (0.1 * lambda1, 4.0 * lambda1),
            (0.1 * lambda3, 4.0 * lambda3), (0.0, 180.0), (-fast, fast), (-slow, slow)]


class SimulatedTrack(Track):
    """A top whose states are computed when they are asked for.  Raises ValueError like `Top`."""

    def __init__(self, values: Mapping[str, Any], about: str) -> None:
        super().__init__(values, about=about, epoch_ns=NANOSECONDS)
        self.trajectory = Simulation(values).trajectory

    def times(self, begin_ns: int, end_ns: int) -> Times:
        first = max(-(-begin_ns // PERIOD_NS), 0) * PERIOD_NS
        return np.append(np.arange(first, end_ns, PERIOD_NS), end_ns)

    def at(self, times: Times) -> States:
        return self.trajectory.evaluate(times)

    def newest(self, t_ns: int) -> int:
        return t_ns

    def pivot_moves(self, t_ns: int) -> bool:
        return self.trajectory.pivot is not None

    def go_on(self, t_ns: int) -> int:
        """Solve up to a time, or as far as the motion goes; return the time that is reached."""
        try:
            self.trajectory.evaluate(np.array([t_ns]))
        except IntegrationError as error:
            return error.reached_ns
        self.trajectory.forget(t_ns - 2 * WINDOW_NS, t_ns - 2 * WINDOW_NS)
        return t_ns


class OwnSimulation:
    """The source of a page that simulates a scene: the name of a file, or its path."""

    def __init__(self, page: Page, scene: str, values: Mapping[str, Any]) -> None:
        self.page, self._reached_ns = page, 0
        self.player = Player(page)
        self.player.file_end_ns = min(self.player.file_end_ns, round(
            (values['duration'] or FILE_S) * NANOSECONDS))
        self._files, self._scene = parameter_files('scene'), Path(scene).stem
        if scene != self._scene:
            self._files[self._scene] = Path(scene)
        gui = page.gui
        with page.controls:
            self._field = gui.add_dropdown('scene', tuple(self._files), initial_value=self._scene)
        with page.controls, gui.add_folder('Top and start'):
            self._sliders = [gui.add_slider(f'{label} [{unit}]', 0.0, 1.0, 1.0 / STEPS, 0.0,
                                            hint=hint) for label, unit, hint in SLIDERS]
        self._show(values)
        self._track = SimulatedTrack(values, self._about())

    def _show(self, values: Mapping[str, Any]) -> None:
        """Show the scene and these parameters on the controls."""
        plain = parameters.checked(read_scene(self._files[self._scene]))
        self._plain, self._numbers = numbers_of(plain), numbers_of(values)
        set_value(self._field, self._scene)
        for slider, number, (low, high) in zip(self._sliders, self._numbers, ranges(
                self._plain, natural_momentum(parameters.top_of(plain))), strict=True):
            slider.min, slider.max = min(low, number), max(high, number)
            slider.step = (slider.max - slider.min) / STEPS
            set_value(slider, number)
        self._shown = [slider.value for slider in self._sliders]

    def _about(self) -> str:
        """The scene, and what is other than in it."""
        changed = [label for (label, *_), number, plain in zip(
            SLIDERS, self._numbers, self._plain, strict=True)
            if abs(number - plain) > 1e-9 * max(abs(number), abs(plain))]
        other = f' with another {", ".join(changed)}' if changed else ''
        return f'Scene {self._scene}{other}; the title names the motion that its numbers make.'

    def _follow_controls(self) -> None:
        """
        Begin another motion at t = 0 if somebody has chosen one.

        Raises ValueError where there is none.  A slider stays under the hand that moves it.
        """
        scene, shown = self._field.value, [one.value for one in self._sliders]
        if scene != self._scene:
            kept = {name: value for name, value in self._track.values.items()
                    if not name.startswith(GROUPS)}
            values = parameters.checked({**kept, **read_scene(self._files[scene])})
            track = SimulatedTrack(values, '')
            self._scene = scene
            self._show(values)
        elif shown != self._shown:
            self._numbers = [new if new != old else number for new, old, number in zip(
                shown, self._shown, self._numbers, strict=True)]
            self._shown = shown
            track = SimulatedTrack(with_numbers(self._track.values, self._numbers), '')
        else:
            return
        track.about, self._track = self._about(), track
        self.page.message.content = track.top.objection
        self._reached_ns = self.player.now_ns = 0

    def update(self, seconds: float) -> int:
        try:
            self._follow_controls()
        except (OSError, ValueError) as error:      # its file may be gone, or be another one
            self.page.message.content = f'**refused:** {text_of(error)}'
            self._show(self._track.values)
        t_ns = self.player.advance(seconds)
        if t_ns < self._reached_ns:
            self._track = SimulatedTrack(self._track.values, self._track.about)
        self._reached_ns = self._track.go_on(t_ns)
        if self._reached_ns < t_ns:
            self.page.message.content = f'The equations end at {self._reached_ns * 1e-9:g} s.'
            self.player.stop_at(self._reached_ns)
        return self._reached_ns

    def track_at(self, _: int) -> SimulatedTrack:
        return self._track
