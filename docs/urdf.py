#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write urdf/spinning_top.urdf from the xacro file beside it: `python docs/urdf.py`."""

from pathlib import Path

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.export import robot_description

HEAD = """<?xml version="1.0"?>
<!-- SPDX-License-Identifier: Apache-2.0 -->
<!-- Written by docs/urdf.py: spinning_top.urdf.xacro with the default parameters. -->
"""
FOLDER = Path(__file__).resolve().parent.parent / 'urdf'


def description() -> str:
    """Return the robot description of the default parameters."""
    text = robot_description(parameters.checked({}), FOLDER)
    return HEAD + text.partition('\n')[2]


if __name__ == '__main__':
    (FOLDER / 'spinning_top.urdf').write_text(description(), encoding='utf-8')
