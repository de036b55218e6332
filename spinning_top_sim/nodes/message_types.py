# SPDX-License-Identifier: Apache-2.0
"""The Python classes of message types, imported when a topic needs them."""

from __future__ import annotations

import importlib


def message_type(type_name: str) -> type:
    """
    Return the class of a type such as 'geometry_msgs/msg/Pose' ('msg' may be left out).

    Raises LookupError when it is not installed.
    """
    package, *folder, name = type_name.split('/')
    try:
        module = importlib.import_module('.'.join((package, *(folder or ['msg']))))
        found: type = getattr(module, name)
    except (ImportError, ValueError, AttributeError) as error:
        raise LookupError(f'{type_name} is not installed') from error
    return found
