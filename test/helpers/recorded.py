# SPDX-License-Identifier: Apache-2.0
"""What a simulation in this process sends to its log."""


def recorded(simulation, topics=None):
    """
    Record a simulation from now on; return {topic: [(stamp [ns], bytes)]}, which grows.

    topics: of the streams to record, None for all
    """
    streams = [stream for stream in simulation.streams
               if topics is None or stream.topic in topics]
    rows = {stream.topic: [] for stream in streams}

    def write(numbers, stamp_ns, messages, size):
        assert size == sum(map(len, messages))
        for number, message in zip(numbers, messages, strict=True):
            rows[streams[number].topic].append((stamp_ns, bytes(message)))

    simulation.log_to(write, streams)
    return rows
