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
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.play import Simulation
from spinning_top_sim.times import NANOSECONDS, Times
from spinning_top_sim.tools.scene_file import read_scene
from spinning_top_sim.view.page import Page, set_value
from spinning_top_sim.view.player import Player
from spinning_top_sim.view.source import WINDOW_NS, Track

FILE_S = 20.0                   # length of a file, where `duration` is 0
STEPS = 500                     # of a slider at least
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

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values, epoch_ns=NANOSECONDS)
        self._simulation, self._reached_ns = Simulation(values), -1
        self.trajectory = self._simulation.trajectory

    def times(self, begin_ns: int, end_ns: int, step_ns: int) -> Times:
        first = max(-(-begin_ns // step_ns), 0) * step_ns
        return np.append(np.arange(first, end_ns, step_ns), end_ns)

    def at(self, times: Times) -> States:
        return self.trajectory.evaluate(times)

    def newest(self, t_ns: int) -> int:
        return t_ns

    def pivot_moves(self, t_ns: int) -> bool:
        return self.trajectory.pivot is not None

    def go_on(self, t_ns: int) -> None:
        """Solve up to a time.  Raises IntegrationError if the motion ends before."""
        while self._reached_ns < t_ns:
            self._reached_ns = self._simulation.reach(self._reached_ns, t_ns)
            before_ns = self._reached_ns - 2 * WINDOW_NS
            self.trajectory.forget(before_ns, before_ns)


class OwnSimulation:
    """The source of a page that simulates a scene: the name of a file, or its path."""

    def __init__(self, page: Page, scene: str, values: Mapping[str, Any]) -> None:
        self.page, self._scene = page, ''
        self.player = Player(page)
        self.player.file_end_ns = min(self.player.file_end_ns, round(
            (values['duration'] or FILE_S) * NANOSECONDS))
        name = Path(scene).stem
        self._files = parameter_files('scene') | ({name: Path(scene)} if scene != name else {})
        gui = page.gui
        with page.controls:
            self._field = gui.add_dropdown('scene', tuple(self._files), initial_value=name)
        with page.controls, gui.add_folder('Top and start'):
            self._sliders = [gui.add_slider(f'{label} [{unit}]', 0.0, 1.0, 1e-3, 0.0, hint=hint)
                             for label, unit, hint in SLIDERS]
        self._begin(name, values)

    def _begin(self, scene: str, values: Mapping[str, Any]) -> None:
        """Begin a motion at t = 0.  Raises OSError, or ValueError where there is none."""
        track = SimulatedTrack(values)
        if scene != self._scene:
            self._plain = parameters.checked(read_scene(self._files[scene]))
            self._scene = scene
            self._show(values)
        other = '' if np.allclose(numbers_of(values), numbers_of(self._plain), 1e-9, 0.0) else (
            ' with other numbers')
        track.about = f'Scene {scene}{other}; the title names the motion that its numbers make.'
        self.track = track
        self.page.message.content = track.top.objection
        self._now_ns = self.player.now_ns = 0

    def _show(self, values: Mapping[str, Any]) -> None:
        """Show the scene and these parameters on the controls."""
        set_value(self._field, self._scene)
        for slider, number, (low, high) in zip(self._sliders, numbers_of(values), ranges(
                numbers_of(self._plain), natural_momentum(parameters.top_of(self._plain))),
                strict=True):
            slider.min, slider.max = min(low, number), max(high, number)
            digits = math.ceil(math.log10(STEPS / (slider.max - slider.min)))
            # More digits than a step has: those of the ends, and of what is typed.
            slider.step, slider.precision = 10.0 ** -digits, max(digits, 0) + 2
            set_value(slider, number)
        self._shown = [slider.value for slider in self._sliders]

    def _follow_controls(self) -> None:
        """
        Begin another motion if somebody has chosen one.

        Raises ValueError where there is none.  A slider stays under the hand that moves it.
        """
        scene, shown = self._field.value, [one.value for one in self._sliders]
        if scene != self._scene:
            kept = {name: value for name, value in self.track.values.items()
                    if not name.startswith(GROUPS)}
            self._begin(scene, parameters.checked({**kept, **read_scene(self._files[scene])}))
        elif shown != self._shown:
            self._begin(scene, with_numbers(self.track.values, shown))
            self._shown = shown
            for slider in self._sliders:        # a number that is typed may be beyond its ends
                slider.min, slider.max = (min(slider.min, slider.value),
                                          max(slider.max, slider.value))

    def update(self, seconds: float) -> int:
        try:
            self._follow_controls()
        except (OSError, ValueError) as error:      # its file may be gone, or be another one
            self.page.message.content = f'**refused:** {text_of(error)}'
            self._show(self.track.values)
        t_ns = self.player.advance(seconds)
        if t_ns < self._now_ns:
            self._begin(self._scene, self.track.values)
            t_ns = 0
        self.track.go_on(t_ns)
        self._now_ns = t_ns
        return t_ns
