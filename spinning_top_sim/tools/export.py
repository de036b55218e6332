# SPDX-License-Identifier: Apache-2.0
"""
Write the top of a scene as a model for physics engines (MJCF, URDF, SDF).

exit codes:
  0    done
  1    the file cannot be written
  2    wrong arguments or parameters, or a top that no model has
"""

import argparse
from functools import partial
from pathlib import Path

from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli, models, scene_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument('--model', choices=models.FORMATS, required=True,
                        help='format of the model')
    scene_file.add_parameters(parser)
    parser.add_argument('-o', '--output', metavar='FILE', type=Path, required=True,
                        help='file to write; an existing one is never overwritten')


def _run(arguments: argparse.Namespace) -> int:
    given = scene_file.given(arguments)
    # An IMU names no scene.
    files = [*([scene_file.file_of('scene', arguments.scene)] if arguments.scene else ()),
             *map(Path, arguments.params)]
    text = models.model(parameters.checked(given), arguments.model,
                        files[0].stem if files else 'spinning_top')
    cli.check_output(arguments.output)
    arguments.output.write_text(text, encoding='utf-8')
    return cli.OK


main = partial(cli.run, 'export', __doc__, add_arguments, _run)
