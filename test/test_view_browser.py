# SPDX-License-Identifier: Apache-2.0
"""The page as a browser shows it, live, from logs and as a file; needs Chromium."""

import re
import signal
from importlib.util import find_spec

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from helpers import browser as browsers
from helpers.browser import Visit
from helpers.node_harness import SimNode, wait_for
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from spinning_top_sim.physics.attitude import angle_between
from spinning_top_sim.recording.reader import LogReader
from spinning_top_sim.tools import simulate
from spinning_top_sim.view import command

pytestmark = pytest.mark.skipif(find_spec('viser') is None, reason='viser is not there')
VIEW = ('-m', 'spinning_top_sim', 'view', '--no-browser', '--port', '0')
STAMP = r'stamp (\d+)\.(\d{9})'


@pytest.fixture(scope='module')
def browser():
    yield from browsers.launch()


def address_of(node):
    return wait_for('the address', lambda: re.search(r'http://[\w.:]+', node.out)).group()


def poses_of(path):
    from rclpy.serialization import deserialize_message
    with LogReader(path) as reader:
        return {message.log_time: deserialize_message(message.data, PoseStamped).pose.orientation
                for message in reader.messages(topics=['/pose'])}


def apart(shown, orientation):
    """Return the angle between a drawn attitude and a published one [rad]."""
    published = orientation.x, orientation.y, orientation.z, orientation.w
    return float(angle_between(*(tuple(np.array([x]) for x in q) for q in (shown, published)))[0])


def test_a_simulation_without_a_node(browser, tmp_path):
    """Its sliders, buttons and scenes are what the browser shows next."""
    own = SimNode(tmp_path, program=(*VIEW, '--scene', 'looping'))
    del own.command[own.command.index('--ros-args'):]
    with own, Visit(browser, address_of(own)) as visit:
        visit.read('[Ll]oops')
        visit.read('Scene looping; the title names the motion')
        visit.wait("document.querySelectorAll('.plot polyline').length >= 7")
        before = visit.attitude()
        wait_for('a picture', lambda: visit.attitude() != before)
        visit.press('Pause')
        visit.press('Reset')
        visit.read(r't = 0\.000 s, stamp 1\.0')
        turned = Rotation.from_euler('y', 30, degrees=True).as_quat()
        wait_for('the start', lambda: np.allclose(visit.attitude(), turned, atol=1e-6))
        visit.put('tilt θ [deg]', 60)
        turned = Rotation.from_euler('y', 60, degrees=True).as_quat()
        wait_for('the other start', lambda: np.allclose(visit.attitude(), turned, atol=1e-6))
        visit.read('Scene looping with another tilt')
        visit.press('Step')
        visit.read(r't = 0\.020 s')
        visit.tick('torque')
        visit.wait("[...document.querySelectorAll('.top-legend')].some("
                   "e => e.textContent.includes('torque'))")
        visit.choose('scene', 'shuttle')
        visit.press('Play')
        visit.read('The pivot moves')
        visit.wait("window.__viserMutable.nodePoseData['/ground'].position[0] < 0")
        assert visit.place('/top') == [0, 0, 0]
        assert visit.errors == []
        assert visit.hosts <= {'127.0.0.1', None}
        assert own.end(signal.SIGTERM) == 0, own.err


def test_a_node(browser, peer, tmp_path):
    with SimNode(tmp_path, {'record.uri': f'{tmp_path}/', 'tick_rate': 50.0}) as node:
        view = SimNode(tmp_path / 'view', namespace=node.namespace, program=(*VIEW, '--node'))
        poses = peer.listen(node.topic('pose'), PoseStamped)
        with view, Visit(browser, address_of(view)) as visit:
            visit.read('[Cc]usps')

            # What is drawn was published, also while it runs.
            shown = visit.attitude()
            wait_for('the pose that is drawn', lambda: any(
                apart(shown, message.pose.orientation) < 1e-6 for message in poses.messages()))

            # A refused command says why, and the motion goes on.
            visit.press('Step')
            visit.read('refused: ')

            # Paused: this very stamp, and the attitude of the pose with it.
            visit.press('Pause')
            (paused_at,) = visit.read(r'pause: paused at t = ([\d.]+) s')
            wait_for('the last pose to be shown', lambda: visit.read(STAMP) == stamp_of(poses))
            wait_for('its attitude', lambda: apart(
                visit.attitude(), poses.last().pose.orientation) < 1e-6)
            # t = 0 is that of the reset as soon as the next /diagnostics have come.
            wait_for('the simulated time of the sample', lambda: -1e-3 < float(paused_at) - float(
                visit.read(r't = ([\d.]+) s, stamp')[0]) < 0.011)
            before = stamp_of(poses)
            visit.press('Step')
            visit.read('step: at t =')
            wait_for('a step', lambda: visit.read(STAMP) > before)
            visit.press('Resume')
            visit.read('pause: running')

            # Another motion, whoever commands it.
            assert peer.set_together(node, spin__l3=2.0, spin__lz=1.5).successful
            visit.read('[Ll]oops')
            visit.press('Reset')
            visit.read('reset: at t = 0')
            assert visit.errors == []
            assert visit.hosts <= {'127.0.0.1', None}

            # The page says when the node ends, and when it ends itself.
            assert node.end() == 0
            visit.read('spinning_top has ended')
            assert view.end(signal.SIGINT) == 0, view.err


def stamp_of(poses):
    seconds, nanoseconds = Time.from_msg(poses.last().header.stamp).seconds_nanoseconds()
    return str(seconds), f'{nanoseconds:09d}'


@pytest.mark.parametrize('scene', ['cusp', 'shuttle'])
def test_file_without_a_network(browser, tmp_path, scene):
    page, log = tmp_path / 'page.html', tmp_path / 'run.mcap'
    assert simulate.main(['--scene', scene, '--duration', '6', '-o', str(log),
                          '--command', '2.5:2.0:1.5']) == 0
    assert command.main([str(log), '--html', str(page)]) == 0
    assert page.stat().st_size < 2e6        # for 6 s
    poses = poses_of(log)
    with Visit(browser, str(page), offline=True, framed=True) as visit:
        # Before the first picture, and where it begins again, viser turns nothing.
        wait_for('a picture', lambda: visit.attitude() != [0, 0, 0, 1])
        shown = visit.attitude()
        assert min(apart(shown, pose) for pose in poses.values()) < 1e-6
        visit.wait("String(window.__viserMutable.nodePoseData['/top/body'].wxyz) != "
                   f"'{','.join(map(str, [shown[3], *shown[:3]]))}'")

        # Beside it: what one sees, in time with the player, legend and plots.
        for words in ('run.mcap', 'trace of the axis', 'Energy', 'Tilt', 'Precession rate'):
            visit.read(words)
        if scene == 'cusp':
            visit.read('Effective potential')
            visit.read(r'Cusps(\n.*)*t = [01]\.\d* s, stamp [12]\.')
            visit.read(r'Loops(\n.*)*t = [3-5]\.\d* s, stamp [4-6]\.')
        else:
            visit.read('The pivot moves')
            place = visit.place('/top')
            visit.wait("window.__viserMutable.nodePoseData['/ground'].position[0] < -0.1")
            assert visit.place('/top') == place
        ends = visit.page.evaluate("[...document.querySelectorAll('.plot')].slice(-3).map("
                                   "plot => plot.dataset.x)")
        assert ends == ['0 6'] * 3
        # The marks follow the scene.
        visit.page.wait_for_function(
            "document.querySelector('.plot:last-child .now').getAttribute('transform')"
            " !== 'translate(46 0)'")
        # Nothing lies over the legend.
        assert visit.page.evaluate("""() => {
            const legend = document.querySelector('.top-legend');
            legend.scrollIntoView();
            const {x, y, width, height} = legend.getBoundingClientRect();
            return legend.contains(document.elementFromPoint(x + width / 2, y + height / 2));
        }""")
        assert visit.errors == []
        assert visit.hosts <= {'', None}
