# SPDX-License-Identifier: Apache-2.0
"""A top in the scene of viser: its body, its trace, the bounds of its tilt, and arrows."""

import math
from collections.abc import Set

import numpy as np
import viser
from numpy.typing import NDArray

from spinning_top_sim.physics import attitude
from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.view import body
from spinning_top_sim.view.source import WINDOW_NS, Motion, Reals, Track

STANDS_TO = math.radians(100.0)     # tilt up to which the pivot stands on a peg; else it hangs
TRACE, BOUNDS, SPHERE, STAND = (217, 72, 43), (122, 82, 179), (190, 200, 215), (120, 126, 136)
FOOT = 0.8                      # length of the stand / that of the axis
ARROWS = {'angular momentum': (20, 120, 70), 'torque': (20, 150, 180)}
NO_LINES = np.zeros((1, 2, 3), np.float32)
REACH = 1.6                     # radius of the sphere of the trace / distance of the tip
LONGEST_CHORD = 0.5             # of a step of the trace / its radius; a longer step is a jump
Lines = NDArray[np.float32]     # (n, 2, 3), as viser takes them


def axis_length(track: Track) -> float:
    """Return the signed length of the drawn axis along e3 [m]; it ends outside of most bodies."""
    return REACH * track.shape.tip


def lines_through(points: Reals) -> Lines:
    """Return the lines (n - 1, 2, 3) from each point (n, 3) to the next."""
    return np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)


def circle(radius: float, theta: float) -> Lines:
    """Return the lines of the circle of all tips with this tilt."""
    phi = np.linspace(0.0, math.tau, 193)
    return lines_through(radius * np.column_stack((
        math.sin(theta) * np.cos(phi), math.sin(theta) * np.sin(phi),
        np.full_like(phi, math.cos(theta)))))


def tip_path(track: Track, t_ns: int) -> Lines:
    """Return the lines along which the tip has moved, up to a time, from where the pivot is."""
    states = track.states(t_ns, t_ns - WINDOW_NS, t_ns)
    axis, place = np.stack(states.rows_axis, axis=1), states.pivot.position.T
    joined = np.linalg.norm(np.diff(axis, axis=0), axis=1) < LONGEST_CHORD
    return lines_through(axis_length(track) * axis + (place - place[-1]))[joined]


def arrow(track: Track, name: str, t_ns: int) -> Reals | None:
    """
    Return one of ARROWS at a sample as a vector (3,) in the world; None: not known.

    The length of the axis stands for the usual angular momentum, and for the torque of gravity
    when the axis is horizontal.
    """
    states, motion, top = track.state(t_ns), track.motion_at(t_ns), track.top
    if name == 'torque':        # r x m g, along the line of nodes
        x, y, _ = states.rows_axis
        vector = np.ravel(np.sign(top.gravity_torque) * np.array((-y, x, 0.0 * x)))
    elif motion is None:
        return None
    else:
        w1, w2, w3 = states.rows_angular_velocity
        usual = max(natural_momentum(top), abs(motion.l3), abs(motion.lz), 1e-30)
        vector = np.ravel(np.broadcast_arrays(*attitude.rotated(states.rows_quaternion, (
            top.lambda1 * w1, top.lambda1 * w2, top.lambda3 * w3)))) / usual
    return abs(axis_length(track)) * vector


class DrawnTop:
    """
    One top in the scene.

    track : whose samples are drawn; may be set
    top : that the body looks like
    """

    def __init__(self, scene: viser.SceneApi, track: Track) -> None:
        self.track, self.top = track, track.top
        name, far = '/top', axis_length(track)
        radius = abs(far)
        self.root = scene.add_frame(name, show_axes=False)
        self._sphere = scene.add_icosphere(f'{name}/sphere', radius, SPHERE, subdivisions=4,
                                           opacity=0.12, side='back', cast_shadow=False,
                                           receive_shadow=False)
        self._body = scene.add_frame(f'{name}/body', show_axes=False)
        for part, (mesh, colour) in body.wheel(track.shape, far).items():
            scene.add_mesh_simple(f'{name}/body/{part}', mesh.vertices, mesh.faces, color=colour,
                                  flat_shading=part != 'axle', side='double')
        peg = body.stand(FOOT * radius)
        self._stand = scene.add_mesh_simple(f'{name}/stand', peg.vertices, peg.faces, color=STAND,
                                            side='double')
        # A trace that begins with one colour for all points would not take others.
        self._trace = scene.add_line_segments(
            f'{name}/trace', NO_LINES, np.broadcast_to(np.array(TRACE), NO_LINES.shape),
            thickness=0.018 * radius)
        self._bounds = [scene.add_line_segments(
            f'{name}/bound{k}', NO_LINES, BOUNDS, thickness=0.007 * radius, visible=False)
            for k in range(2)]
        self._arrows = {title: scene.add_arrows(
            f'{name}/{title.replace(" ", "_")}', NO_LINES, colour,
            shaft_radius=0.014 * radius, head_radius=0.04 * radius, head_length=0.12 * radius,
            visible=False) for title, colour in ARROWS.items()}
        self._motion: Motion | None = None              # whose bounds are drawn
        self._picture: object = None                    # what it shows

    def draw(self, t_ns: int, *, trace: bool, bounds: bool, arrows: Set[str]) -> None:
        """Draw the newest sample up to a time, with some of the parts."""
        sample_ns = self.track.newest(t_ns)
        self.root.visible = sample_ns is not None
        picture = self.track, sample_ns, trace, bounds, arrows
        if sample_ns is None or picture == self._picture:       # as while it is paused
            return
        self._picture = picture
        x, y, z, w = self.track.state(sample_ns).quaternion[0].tolist()
        self._body.wxyz = (w, x, y, z)
        self._trace.visible = self._sphere.visible = trace
        if trace:
            self._draw_trace(tip_path(self.track, sample_ns))
        for name, handle in self._arrows.items():
            handle.visible = name in arrows
            vector = arrow(self.track, name, sample_ns) if handle.visible else None
            handle.points = NO_LINES if vector is None else lines_through(
                np.vstack((np.zeros(3), vector)))
        self._draw_bounds(self.track.motion_at(t_ns), bounds)

    def _draw_trace(self, lines: Lines) -> None:
        """Draw a trace that fades with its age; the colours of a line's points are linear."""
        lines = lines if len(lines) else NO_LINES
        is_longer = len(lines) != len(self._trace.points)
        self._trace.points = lines
        if is_longer:
            share = np.linspace(0.35, 1.0, len(lines))[:, np.newaxis, np.newaxis]
            self._trace.colors = np.broadcast_to(255 * (
                1.0 + share * (np.array(TRACE) / 255 - 1.0)) ** 2.2, lines.shape).astype(np.uint8)

    def _draw_bounds(self, motion: Motion | None, on: bool) -> None:
        description = motion.description if motion else None
        for bound in self._bounds:
            bound.visible = on and description is not None
        if description is None or motion is self._motion:
            return
        self._motion = motion
        for bound, theta in zip(self._bounds, (description.theta_min, description.theta_max),
                                strict=True):
            bound.points = circle(axis_length(self.track), theta)
        # A top that comes low hangs from above.
        self._stand.wxyz = (1, 0, 0, 0) if description.theta_max < STANDS_TO else (0, 1, 0, 0)
