# SPDX-License-Identifier: Apache-2.0
"""
Write the top of a scene as a model for physics engines (MJCF, URDF, SDF), or
reference trajectories and models of all scenes.

exit codes:
  0    done
  1    a file cannot be written, or a library is missing
  2    wrong arguments or parameters, or a top that no model has
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from spinning_top_sim.installation import parameter_files
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools import cli, models, reference, scene_file


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, by default the program's; return its exit code."""
    return cli.run('export', __doc__, argv, add_arguments, _run)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument('--model', choices=models.FORMATS, help='write one model to -o FILE')
    kind.add_argument('--reference', metavar='FOLDER', type=Path,
                      help='write trajectories (CSV, Parquet), models and a description of all '
                      'scenes, or of the one that is given, into a new folder')
    scene_file.add_parameters(parser)
    parser.add_argument('-o', '--output', metavar='FILE', type=Path,
                        help='file of the model; an existing one is never overwritten')
    parser.add_argument('--duration', type=float, default=10.0, metavar='S',
                        help='of the trajectories, default %(default)g s')
    parser.add_argument('--rate', type=float, default=100.0, metavar='HZ',
                        help='of the trajectories, default %(default)g Hz')


def _run(arguments: argparse.Namespace) -> int:
    given = scene_file.given(arguments)
    files = [*scene_file.chosen_files(arguments), *map(Path, arguments.params)]
    name = files[0].stem if files else 'spinning_top'
    if arguments.model:
        if arguments.output is None:
            raise ValueError('--model: -o FILE must be given')
        text = models.model(parameters.checked(given), arguments.model, name)
        cli.check_output(arguments.output)
        arguments.output.write_text(text, encoding='utf-8')
        return cli.OK
    if arguments.output is not None:
        raise ValueError(f'-o {arguments.output}: must not be given with --reference')
    for option, most in (('duration', parameters.LONGEST), ('rate', parameters.HIGHEST_RATE)):
        if not 0.0 < getattr(arguments, option) <= most:
            raise ValueError(f'--{option} {getattr(arguments, option)!r}: must be > 0 and '
                             f'<= {most:g}')
    scenes = {name: given} if files else {
        stem: {**scene_file.read_scene(path), **given}
        for stem, path in parameter_files('scene').items()}
    cli.check_output(arguments.reference)
    reference.write(arguments.reference, {
        name: reference.with_imu(values) for name, values in scenes.items()},
        arguments.duration, arguments.rate)
    return cli.OK
