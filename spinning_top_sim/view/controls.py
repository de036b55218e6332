# SPDX-License-Identifier: Apache-2.0
"""The controls of the live page: sliders and buttons for a sim_node, and its answers."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import viser

from spinning_top_sim.installation import parameter_files
from spinning_top_sim.nodes.recording import RECORDED_FILE, RECORDER
from spinning_top_sim.nodes.status import SPEED, STATE, TIME
from spinning_top_sim.physics.regimes import natural_momentum
from spinning_top_sim.physics.top import Top
from spinning_top_sim.view.node_client import NodeClient
from spinning_top_sim.view.page import Page, set_content, set_value

STEPS = 1000                    # of a slider
# Velocity x, y of the pivot [m/s] that a button asks for, until `pivot.cmd_timeout` ends it.
PAD = {'−x': (-0.5, 0.0), '+x': (0.5, 0.0), '−y': (0.0, -0.5), '+y': (0.0, 0.5),
       'stop': (0.0, 0.0)}
LEFT_ALONE_S = 1.0              # after that a slider follows the node again


class Controls:
    """The controls.  Their callbacks run in threads of viser; only one at a time acts."""

    def __init__(self, page: Page, client: NodeClient) -> None:
        self._page, self._client = page, client
        self._lock = threading.Lock()
        self._paused = False
        self._spin = [0.0, 0.0]                     # L3 and Lz of the node
        self._moved_at = 0.0                        # time of the last move, monotonic clock
        self._shown = [math.nan, math.nan]          # values on the sliders
        gui = page.gui
        with page.controls:
            self._status = gui.add_markdown('*waiting for sim_node*')
            self._scene = gui.add_dropdown('scene', ('', *parameter_files('scene')), hint=(
                'set the top and the start of an installed scene, and reset'))
            self._sliders = [gui.add_slider(label, -1.0, 1.0, 2.0 / STEPS, 0.0, hint=hint)
                             for label, hint in (
                ('L3 [kg m²/s]', 'angular momentum about the axis of the top'),
                ('Lz [kg m²/s]', 'angular momentum about the vertical'))]
            self._pause = gui.add_button('Pause')
            step, reset = gui.add_button('Step'), gui.add_button('Reset')
            self._record = gui.add_checkbox('record', False)
            pad = gui.add_button_group('pivot', tuple(PAD), hint=(
                'push the pivot: 0.5 m/s along an axis of the world; it brakes soon'))
        for slider in self._sliders:
            slider.on_update(self._on_slider)
        self._pause.on_click(lambda _: self._act(self._switch_pause))
        step.on_click(lambda _: self._act(lambda: client.call('step')))
        reset.on_click(lambda _: self._act(lambda: client.call('reset')))
        pad.on_click(lambda _: self._act(lambda: client.drive(*PAD[pad.value])))
        self._record.on_update(self._on_record)
        self._scene.on_update(self._on_scene)

    def _act(self, action: Callable[[], str]) -> None:
        with self._lock:
            try:
                self._page.message.content = action()
            except Exception as error:
                self._page.message.content = f'**refused:** {error}'

    def _on_record(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:        # somebody in a browser
            self._act(lambda: self._client.call('record', self._record.value))

    def _on_scene(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None and self._scene.value:
            self._act(lambda: self._client.choose(self._scene.value))

    def _on_slider(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self._moved_at = time.monotonic()       # at once: a request before may wait
            self._act(self._send)

    def _send(self) -> str:
        values = [slider.value for slider in self._sliders]
        l3, lz = (value if abs(value - shown) > 0.5 * self._sliders[0].step else present
                  for value, shown, present in zip(values, self._shown, self._spin, strict=True))
        if [l3, lz] == self._spin:      # they are sent: a slider may move while a request waits
            return self._page.message.content
        try:
            said = self._client.command(l3, lz)
        except Exception:
            self._leave_sliders()           # show the spin of the node again
            self.show_spin(*self._spin)
            raise
        self._spin, self._shown = [l3, lz], values
        return said

    def _switch_pause(self) -> str:
        said = self._client.call('set_pause', not self._paused)
        self._show_paused(not self._paused)
        return said

    def _show_paused(self, paused: bool) -> None:
        self._paused = paused
        self._pause.label = 'Resume' if paused else 'Pause'

    def set_range(self, top: Top, l3: float, lz: float) -> None:
        """Set the range of the sliders to twice the greater of the present and the usual spin."""
        usual = 2.0 * natural_momentum(top)         # the least spin to sleep
        reach = 2.0 * (max(abs(l3), abs(lz), usual) or 1.0)
        digits = 1 - math.floor(math.log10(reach))
        reach = math.ceil(reach * 10.0 ** digits) / 10.0 ** digits
        for slider in self._sliders:
            slider.min, slider.max, slider.step = -reach, reach, 2.0 * reach / STEPS
        self._leave_sliders()
        self.show_spin(l3, lz)

    def _leave_sliders(self) -> None:
        """Make the next `show_spin` set the sliders in any case."""
        self._moved_at, self._shown = 0.0, [math.nan, math.nan]

    def show_spin(self, l3: float, lz: float) -> None:
        """Show the spin of the node on the sliders, unless somebody is moving them."""
        self._spin = [l3, lz]
        if time.monotonic() - self._moved_at > LEFT_ALONE_S:
            for k, (slider, value) in enumerate(zip(self._sliders, self._spin, strict=True)):
                # Setting an unchanged value would undo a move whose callback has not come yet.
                if not abs(value - self._shown[k]) < 0.5 * slider.step:
                    set_value(slider, min(max(value, slider.min), slider.max))
                    self._shown[k] = slider.value

    def tell_status(self, message: str, numbers: Mapping[str, str]) -> None:
        """Show what the node says in /diagnostics: its message, and its numbers by their keys."""
        recorder, path = numbers[RECORDER], numbers.get(RECORDED_FILE, '')
        self._status.content = ' · '.join(filter(None, (
            message, f't = {float(numbers[TIME]):.1f} s', f'{SPEED} {numbers[SPEED]}',
            f'recorder {recorder} {path}'.rstrip())))
        if not self._lock.locked():
            if numbers[STATE] in ('paused', 'running'):
                self._show_paused(numbers[STATE] == 'paused')
            # A click whose callback has not come yet would be undone.
            is_on, clicked_at = recorder == 'recording', self._record.update_timestamp
            if self._record.value != is_on and time.time() - clicked_at > LEFT_ALONE_S:
                set_value(self._record, is_on)

    def tell_end(self, reason: str) -> None:
        """Show why no samples come, until the next `tell_status`."""
        set_content(self._status, f'**{reason}**')
