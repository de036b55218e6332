# SPDX-License-Identifier: Apache-2.0
"""Full names of topics, without ROS."""

from __future__ import annotations

NODE_NAME = 'spinning_top'


def resolve_topic(topic: str, namespace: str) -> str:
    """
    Return a topic's full name, as ROS resolves it for the node spinning_top.

    Parameters
    ----------
    topic : str
        Relative ('pose'), private ('~/commands') or absolute ('/clock').
    namespace : str
        Namespace of the node, with or without slashes at its ends.
    """
    if topic.startswith('/'):
        return topic
    parts = [namespace.strip('/'), topic.replace('~', NODE_NAME, 1)]
    return '/' + '/'.join(filter(None, parts))
