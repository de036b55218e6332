# SPDX-License-Identifier: Apache-2.0
"""What is said where extras are missing; .ci/wheel tests the wheel and the source distribution."""

import json
import os
import shutil
import subprocess
import sys

from helpers.reference import ROOT

from spinning_top_sim.__main__ import COMMANDS, main

# Commands, and the extra that they need.
REMEDIES = [
    (['node'], "pip install 'ros-jazzy-rclpy"),
    (['view'], "pip install 'viser"),
    (['inspect', 'a.mcap', '--plot', 'a.png'], "pip install 'matplotlib"),
    (['simulate', '--duration', '1', '-o', 'b.parquet'], "pip install 'pyarrow"),
    (['simulate', '--duration', '1', '-o', 'b.mcap', '-p', 'gnss.enabled:=true'],
     "pip install 'pymap3d"),
    (['examine', '--filter', 'vqf'], "pip install 'vqf"),
    (['ensemble', 'e.yaml', '-o', 'runs'], "pip install 'distributed"),
]
EXTRAS = ('rclpy', 'viser', 'matplotlib', 'pyarrow', 'pymap3d', 'vqf', 'dask', 'distributed',
          'geometry_msgs', 'sensor_msgs', 'std_msgs')
RUN_ALL = """
import contextlib, io, json, sys
lines, missing = json.loads(sys.argv[1])
sys.modules.update(dict.fromkeys(missing))
from spinning_top_sim.__main__ import main
said = []
for arguments in lines:
    with (contextlib.redirect_stdout(io.StringIO()) as out,
          contextlib.redirect_stderr(io.StringIO()) as err):
        try:
            code = main(arguments)
        except SystemExit as ended:
            code = ended.code
    said.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(said))
"""


def test_without_extras_there_is_help_and_what_is_missing_is_told_with_its_remedy(tmp_path):
    assert main(['simulate', '--duration', '0.1', '--quiet', '-o', str(tmp_path / 'a.mcap')]) == 0
    shutil.copy(ROOT / 'examples/ensemble.yaml', tmp_path / 'e.yaml')
    helps = [['--help'], *([name, '--help'] for name in COMMANDS)]
    lines = [*helps, *(arguments for arguments, _ in REMEDIES)]
    said = json.loads(subprocess.check_output(
        [sys.executable, '-c', RUN_ALL, json.dumps([lines, EXTRAS])], cwd=tmp_path, timeout=120,
        env={**os.environ, 'PYTHONPATH': str(ROOT)}))
    for name, (code, out, err) in zip(['', *COMMANDS], said, strict=False):
        assert (code, err) == (0, '') and out.startswith(f'usage: spinning-top {name}')
    for (arguments, remedy), (code, _, err) in zip(REMEDIES, said[len(helps):], strict=True):
        assert code in (1, 2)
        assert err.startswith(f'spinning-top {arguments[0]}: ') and err.count('\n') == 1
        assert f'{sys.executable} -m {remedy}' in err
