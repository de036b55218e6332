# SPDX-License-Identifier: Apache-2.0
"""
Grade a recording: is this IMU that of this motion?  Of a top, is this motion right?

  spinning-top grade run.mcap                       # poses and readings of any body
  spinning-top grade run.csv --lever-arm 0.1 0 0.2
  spinning-top grade run.csv --columns 't=stamp:ns, gx=gyro_x:deg/s, ...'
  spinning-top grade run.csv --scene looping        # also the motion of a top that is known

exit codes:
  0    no fault was found
  1    there are faults, or the file cannot be read
  2    wrong arguments, or a file that is not understood
  130  interrupted
docs/grade.md says what a file may contain.
"""

import argparse
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import files, rigid
from spinning_top_sim.grade.effects import Imu
from spinning_top_sim.grade.grader import Judgement, TOLERANCE, Truth
from spinning_top_sim.grade.kinematics import Stretch, stretches
from spinning_top_sim.grade.logs import read_log
from spinning_top_sim.grade.scenes import Body, Start
from spinning_top_sim.streams import parameters
from spinning_top_sim.streams.simulation import Simulation
from spinning_top_sim.tools import cli, scene_file
from spinning_top_sim.tools.report import Finding, Report

START = 0.02            # angle to the start that is given, beyond which there is another [rad]
# Faults that the parameters of a log of this package declare as errors of its device.
DECLARED = {'bias': ('bias', 'random_walk'), 'matrix': ('_M', '_A'), 'mounting': ('_M',),
            'reading_scale': ('_M',), 'late': ('stamp_', 'bandwidth', 'clock_drift', 'sampling'),
            'held': ('duplicate', 'drop_rate'), 'inaccurate': ('range', 'vibration', 'bandwidth')}
DECLARED['early'] = DECLARED['late']
