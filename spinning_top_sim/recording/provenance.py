# SPDX-License-Identifier: Apache-2.0
"""What a log says about the run it holds: enough to compute the run again."""

import json
import platform
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from spinning_top_sim.installation import version

METADATA_NAME = 'spinning_top_sim'
OUR_LIBRARY = 'spinning_top_sim '   # what the header of our files begins with

FORMAT = '2'        # of these keys; 1.x wrote 1
LIBRARIES = ('numpy', 'mcap', 'gmpy2', 'pymap3d')   # those installed decide the last bits


def run_metadata(values_at_start: Mapping[str, Any], epoch_ns: int, begun_ns: int,
                 history: Iterable[str], values_at_recording: Mapping[str, Any]) -> dict[str, str]:
    """
    Return the metadata record METADATA_NAME, but for the `environment`.

    values_at_start : parameters at the start of the motion (the last reset)
    epoch_ns, begun_ns : stamp of t = 0; simulated time at which the recording begins
    history : the JSON of each event before
    """
    return {
        'format': FORMAT,
        'parameters': json.dumps(dict(values_at_start), default=list, sort_keys=True),
        'parameters_now': json.dumps(dict(values_at_recording), default=list, sort_keys=True),
        'seed': str(values_at_start['seed']),
        'epoch_ns': str(epoch_ns),
        'begun_ns': str(begun_ns),
        'history': f'[{", ".join(history)}]'}


def environment() -> dict[str, str]:
    """Return what else decides the last bits: version, machine, libraries.  It takes 20 ms."""
    return {
        'version': version(),
        'platform': f'{platform.machine()} {platform.system()} '
                    f'{platform.python_implementation()} {platform.python_version()} '
                    f'{sys.byteorder}{_vectors()}',
        'libraries': json.dumps({name: found for name in LIBRARIES
                                 if (found := version(name)) != 'unknown'})}


def _vectors() -> str:
    """Return ' AVX-512' where NumPy uses it: sines and exponentials have other last bits then."""
    config: Any = np.show_config(mode='dicts')
    found = config['SIMD Extensions'].get('found', ())
    return ' AVX-512' * any(name == 'X86_V4' or name.startswith('AVX512') for name in found)
