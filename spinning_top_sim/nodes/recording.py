# SPDX-License-Identifier: Apache-2.0
"""The recordings of a running simulation: which log is open, and what goes into it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from spinning_top_sim.streams.channel import Channel
from spinning_top_sim.streams.events import TOPICS, Event
from spinning_top_sim.streams.live import LiveSimulation
from spinning_top_sim.streams.topics import recorded

# Importing it takes long, so that is left to the start of a recording.
if TYPE_CHECKING:
    from spinning_top_sim.recording.recorder import Recorder

RECORDER, RECORDED_FILE = 'recorder', 'recorded file'        # keys in /diagnostics

Topic = tuple[str, str, dict[str, int]]     # full name, type, and offered QoS
Answer = Callable[[bool, str], object]      # takes success and a text


class Recording:
    """
    Records a simulation into one log at a time; the recorder's own thread uses the disk.

    topics : returns the topics of channels, and after them those of events
    options : further arguments of each `Recorder`
    error : why the last recording stopped early or did not start
    """

    def __init__(self, simulation: LiveSimulation,
                 topics: Callable[[Sequence[Channel]], list[Topic]], **options: Any) -> None:
        self.error: str | None = None
        self._simulation, self._topics, self._options = simulation, topics, options
        self._recorder: Recorder | None = None
        # Logs that are being opened or closed: the states meanwhile, and what tells who waits.
        self._requests: list[tuple[Recorder, Sequence[str], Callable[[], object]]] = []
        self._events_index = 0              # index of the first topic of events in the log

    def start(self, values: Mapping[str, Any], answer: Answer = lambda *_: None) -> None:
        """Record from now on; `check` answers once the file is open."""
        recorder = self._recorder = self._recorder or self._begin(values)
        self._requests.append((recorder, ('opening',), lambda: answer(
            recorder.error is None, recorder.error or f'recording to {recorder.path}')))

    def _begin(self, values: Mapping[str, Any]) -> Recorder:
        from spinning_top_sim.recording.provenance import run_metadata  # noqa: PLC0415
        from spinning_top_sim.recording.recorder import Recorder  # noqa: PLC0415
        from spinning_top_sim.recording.rosbag2 import RecordedTopic  # noqa: PLC0415
        simulation = self._simulation
        channels = recorded(simulation.channels, values)
        recorder = Recorder(
            values['record.uri'], [RecordedTopic(*topic) for topic in self._topics(channels)],
            partial(run_metadata, simulation.values_at_start, simulation.epoch_ns,
                    simulation.sent_ns, tuple(simulation.history), values),
            max_loss=values['record.max_loss'], compression=values['record.compression'],
            min_free_bytes=values['record.min_free_bytes'], **self._options)
        self.error, self._recorder, self._events_index = None, recorder, len(channels)
        simulation.log_to(recorder.write, channels)
        self.write(Event('start', simulation.now_ns, simulation.sent_ns))
        return recorder

    def end(self, answer: Answer = lambda *_: None, error: str | None = None) -> None:
        """Record no more; `check` answers once the file is closed."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            answer(True, 'not recording')
            return
        self._simulation.log_to(None)
        recorder.end()
        self.error = error
        self._requests.append((recorder, ('opening', 'recording'), lambda: answer(
            recorder.error is None, _summary(recorder))))

    def check(self) -> str | None:
        """Answer the requests that are done; return why a recording has stopped by itself."""
        for request in list(self._requests):
            recorder, states, tell = request
            if recorder.state not in states:
                self._requests.remove(request)
                tell()
        stopped = self._recorder
        if stopped is None or stopped.state != 'failed':
            return None
        self.end(error=stopped.error)
        return stopped.error

    def close(self) -> str | None:
        """Wait until all logs are closed; return a text for the user about the last one."""
        recorder = self._recorder
        self.end()
        for one in dict.fromkeys(asked for asked, *_ in self._requests):    # each waits once
            one.close()
        self.check()
        if recorder is None or recorder.path is None:
            return None
        return (f'{_summary(recorder)}\nnext: spinning-top inspect {recorder.path}\n'
                f'      spinning-top view {recorder.path}')

    def write(self, event: Event) -> None:
        """Record an event, if a recording goes on."""
        recorder, simulation = self._recorder, self._simulation
        if recorder is not None:
            from spinning_top_sim.recording.recorder import single  # noqa: PLC0415
            recorder.write([single(
                self._events_index + list(TOPICS).index(topic), simulation.epoch_ns + event.t_ns,
                data) for topic, data in event.entries()])

    def has_room(self, wait_s: float = 0.0) -> bool:
        """Return whether the recorder takes more messages, after a wait at most."""
        recorder = self._recorder
        return recorder is None or recorder.room or bool(wait_s and recorder.wait_for_room(wait_s))

    @property
    def warning(self) -> str | None:
        """A text for the user while the disk is too slow for `record.max_loss`."""
        return self._recorder.warning if self._recorder else None

    @property
    def is_on(self) -> bool:
        """Whether messages are recorded, if only in memory while the file is being opened."""
        return self._recorder is not None

    def numbers(self) -> dict[str, object]:
        """Return what /diagnostics say of the recorder, by their keys."""
        recorder = self._recorder
        if recorder is None:
            return {RECORDER: 'failed' if self.error else 'off'}
        messages, size = recorder.written
        return {RECORDER: recorder.state, RECORDED_FILE: recorder.path,
                'recorded messages': messages, 'recorded bytes': size,
                'queued messages': recorder.missing,
                'possible loss [s]': f'{recorder.possible_loss:.3f}'}


def _summary(recorder: Recorder) -> str:
    messages, size = recorder.written
    text = f'{recorder.path}: {messages} messages, {size / 1e6:.1f} MB'
    return f'{text}; stopped early: {recorder.error}' if recorder.error else text
