# SPDX-License-Identifier: Apache-2.0
"""Parameter files: `simulate` finds in them what rclpy finds for `sim_node`."""

import json

import pytest
import yaml

from spinning_top_sim import scene as api_scene
from spinning_top_sim.installation import parameter_files
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.streams import parameters
from spinning_top_sim.tools.scene_file import parse_assignment, parse_yaml, read_scene
from spinning_top_sim.tools.simulate import main

VALUES = ['1e-9', '1e5', '-1E+5', '1.5', '.5', '5.', '+5', '-3', '010', '08', '0x1F', '0', '1_000',
          '1:30', '~', 'null', 't', 'y', 'No', 'on', 'True', '.inf', 'nan', '.NaN',
          '-.nan', '2020-01-01', '0b11', '1e', 'e5', '""', '"1"', "'true'", '!!str 5', 'a b',
          '[1, 2, 3]', '[1.0, 2e3]', '[a, b]', '["1", a]', '[true, false]']


@pytest.fixture(scope='module')
def ros_parameters():
    """Return what returns the parameters of a node that is started with a parameter file."""
    pytest.importorskip('rclpy')
    import helpers.node_harness  # noqa: F401 - DDS stays on this machine
    import rclpy
    from rclpy.context import Context
    from rclpy.node import Node

    def ros_parameters(path, name='/spinning_top'):
        namespace, _, name = name.rpartition('/')
        node = Node(name, context=context, namespace=namespace, use_global_arguments=False,
                    cli_args=['--ros-args', '--params-file', str(path)],
                    enable_rosout=False, start_parameter_services=False,
                    automatically_declare_parameters_from_overrides=True)
        found = {name: one.value for name, one in node.get_parameters_by_prefix('').items()}
        node.destroy_node()
        return found

    context = Context()
    rclpy.init(args=[], context=context)
    yield ros_parameters
    rclpy.shutdown(context=context)


def scene(path, **values):
    lines = (f'    {name}: {text}\n' for name, text in values.items())
    path.write_text('/**:\n  ros__parameters:\n' + ''.join(lines))
    return path


def test_values_have_the_types_that_rcl_finds(ros_parameters, tmp_path):
    path = scene(tmp_path / 'p.yaml', **{f'p{k}': text for k, text in enumerate(VALUES)})
    theirs = ros_parameters(path)
    for k, text in enumerate(VALUES):
        assert repr(parse_yaml(text, text)) == repr(theirs[f'p{k}']), text


def test_a_number_in_quotes_is_a_number_where_a_double_is_wanted(tmp_path):
    """YAML 1.1, of `ros2 param set`, takes 1e-9 for a text; the rule is the same for all."""
    for text, value in (("'1e-9'", 1e-9), ("'3.5'", 3.5), ('3', 3.0)):
        assert parse_assignment(f'spin.l3:={text}')[1] == value
        assert read_scene(scene(tmp_path / 'p.yaml', **{'spin.l3': text})) == {'spin.l3': value}
        assert parameters.checked({'spin.l3': yaml.safe_load(text)})['spin.l3'] == value
    assert parse_assignment("imu.lever_arm:=['1e-2', '2E0', '.5e3']")[1] == (0.01, 2.0, 500.0)


SECTIONS = [
    '/**', '/*', '**', '*', '/**/spinning_top', 'left/spinning_top', '/left/spinning_top',
    '/left/*', '/left/**', '/*/spinning_top', '/**/left/**', '/**/*', '/*/*', '/a/**/spinning_top',
    '/a/*/spinning_top', '/left/other', '/left/spinning', '/leftspinning_top',
    ('/**', 'spinning_top'), ('left', 'spinning_top'), ('/left', '*'), ('a', 'b', 'spinning_top')]


@pytest.mark.parametrize('node', ['/spinning_top', '/left/spinning_top', '/a/b/spinning_top',
                                  '/left/other'])
def test_a_section_applies_to_the_nodes_that_rcl_applies_it_to(ros_parameters, tmp_path, node):
    path = tmp_path / 'p.yaml'
    for section in SECTIONS:
        content = {'ros__parameters': {'world_frame': 'map'}}
        for key in reversed([section] if isinstance(section, str) else section):
            content = {key: content}
        path.write_text(yaml.dump(content))
        if 'world_frame' not in ros_parameters(path, node):
            with pytest.raises(ValueError, match=f'no parameters for the node {node}: '):
                read_scene(path, node)
        else:
            assert read_scene(path, node) == {'world_frame': 'map'}, section


def test_a_namespace_is_the_prefix_of_frames_but_the_world_and_of_nothing_else(tmp_path, capsys):
    path, options = tmp_path / 'left.mcap', ['--namespace', '/left/', '--duration', '1', '--quiet']
    for frame in ('5', "''", '/chip'):
        assert main([*options, '-p', f'imu.frame_id:={frame}', '-o', str(path)]) == 2
        assert 'imu.frame_id = ' in capsys.readouterr().err
    assert main([*options, '-p', 'imu.frame_id:=chip', '-o', str(path)]) == 0
    with LogReader(path) as log:
        values = json.loads(log.metadata['spinning_top_sim']['parameters'])
    assert [values[name] for name in parameters.FRAMES] == ['world', 'left/base_link', 'left/chip']


def test_a_file_that_names_the_node_applies_in_any_namespace(ros_parameters, tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text(''.join(f'{name}: {{ros__parameters: {{world_frame: f{k}}}}}\n'
                            for k, name in enumerate(['/**', '/**/spinning_top', '/*', 'other'])))
    # The last section of the node decides.
    assert read_scene(path) == {'world_frame': ros_parameters(path)['world_frame']}
    path.write_text('spinning_top:\n  ros__parameters:\n    top.mass: 5\n')
    for node in ('/spinning_top', '/left/spinning_top', '/left/another_name'):
        assert read_scene(path, node) == {'top.mass': 5.0}
    path.write_text('another_name: {ros__parameters: {top.mass: 5, use_sim_time: true}}')
    assert parameters.checked(read_scene(path, '/left/another_name'))['top.mass'] == 5.0
    path.write_text('/left/other: {ros__parameters: {a: 1}}\nb: {c: {ros__parameters: {a: 1}}}')
    with pytest.raises(ValueError, match=r'for the node /a/spinning_top: .* nodes: /left/other, '
                       '/b/c'):
        read_scene(path, '/a/spinning_top')


def test_a_scene_is_the_top_and_the_start_of_its_file(tmp_path):
    values = parameters.checked(read_scene(parameter_files('scene')['wavy']))
    assert api_scene('wavy') == (parameters.top_of(values), parameters.start_state(values))
    assert api_scene(str(scene(tmp_path / 'mine.yaml', **{'top.mass': 3})))[0].mass == 3.0
    for name, told in (('shuttle', 'scene shuttle: its pivot moves'),
                       ('lopping', r'^scene lopping: must be the path of a file, or one of brak'),
                       (3, '^scene 3: must be the path of a file, or one of ')):
        with pytest.raises(ValueError, match=told):
            api_scene(name)


def test_a_preset_sets_all_errors_of_an_imu_that_another_sets_and_nothing_else():
    """So any preset replaces any other, and a scene keeps its motion and its mounting."""
    given = {name: read_scene(path) for name, path in parameter_files('imu').items()}
    perfect, magnetic = given.pop('perfect'), given.pop('icm_20948')
    assert parameters.checked(perfect) == parameters.checked({})
    assert not perfect.keys() & {'imu.lever_arm', 'imu.rpy', 'imu.rate'} and len(given) > 2
    for one in given.values():
        assert one.keys() == given['bmi088'].keys() < magnetic.keys()
        assert one['mag.enabled'] is False
    assert magnetic.keys() - {'mag.enabled', 'mag.rate'} < perfect.keys()
