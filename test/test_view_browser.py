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


def test_live(browser, peer, tmp_path):
    with SimNode(tmp_path, {'record.uri': f'{tmp_path}/', 'tick_rate': 50.0}) as node:
        view = SimNode(tmp_path / 'view', namespace=node.namespace, program=VIEW)
        poses = peer.listen(node.topic('pose'), PoseStamped)
        with view, Visit(browser, address_of(view)) as visit:
            visit.read('[Cc]usps')

            # What is drawn was published, also while it runs.
            shown = visit.attitude()
            wait_for('the pose that is drawn', lambda: any(
                apart(shown, message.pose.orientation) < 1e-6 for message in poses.messages()))

            # A command, as of any client.
            visit.put('L3 [kg m²/s]', 2.0)
            visit.read(r'spin\.l3 = 2')

            # A refused one says why, and the motion goes on.
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
            # The plots have data, and a switched-on arrow is in the scene.
            visit.wait("document.querySelectorAll('.plot polyline').length >= 7")
            visit.tick('torque')
            visit.wait("[...document.querySelectorAll('.top-legend')].some("
                       "e => e.textContent.includes('torque'))")

            # The pad pushes the pivot: the ground moves under it.
            visit.press('+x')
            visit.read(r'pivot: 0\.5, 0 m/s')
            visit.read('The pivot moves')
            visit.read(r'Pivot\s+0\.\d+, 0, 0')
            assert visit.place('/ground')[0] < 0.0 == visit.place('/ground')[1]
            assert visit.place('/top0') == [0, 0, 0]

            # A chosen scene is another top, from its start.
            visit.choose('scene', 'wavy')
            visit.read('wavy, reset: at t = 0')
            visit.read('[Ww]aves')
            visit.press('Reset')
            visit.read('(^|[^ ] ?)reset: at t = 0')
            assert visit.errors == []
            assert visit.hosts <= {'127.0.0.1', None}

            # The page says when the node ends, and when it ends itself.
            assert node.end() == 0
            visit.read('spinning_top has ended')
            assert view.end(signal.SIGINT) == 0, view.err


def stamp_of(poses):
    seconds, nanoseconds = Time.from_msg(poses.last().header.stamp).seconds_nanoseconds()
    return str(seconds), f'{nanoseconds:09d}'


def test_file_without_a_network(browser, tmp_path):
    page, ride, log = (tmp_path / name for name in ('page.html', 'ride.mcap', 'cusp.mcap'))
    for path, scene in ((ride, 'shuttle'), (log, 'cusp')):
        assert simulate.main(['--scene', scene, '--duration', '6', '-o', str(path),
                              '--command', '2.5:2.0:1.5']) == 0
    assert command.main([str(ride), str(log), '--html', str(page)]) == 0
    assert page.stat().st_size < 3e6        # for 6 s of two tops
    poses = poses_of(ride)
    with Visit(browser, str(page), offline=True, framed=True) as visit:
        # Before the first picture, and where it begins again, viser turns nothing.
        wait_for('a picture', lambda: visit.attitude() != [0, 0, 0, 1])
        shown = visit.attitude()
        assert min(apart(shown, pose) for pose in poses.values()) < 1e-6
        visit.wait("String(window.__viserMutable.nodePoseData['/top0/body'].wxyz) != "
                   f"'{','.join(map(str, [shown[3], *shown[:3]]))}'")

        # Beside it: the logs, what one sees before and after the command, legend and plots.
        for words in ('ride.mcap', 'cusp.mcap', '[Cc]usps', 'Released without a push', '[Ll]oops',
                      'trace of the axis', 'Effective potential', 'Energy', 'Tilt',
                      'Precession rate', 'The pivot moves'):
            visit.read(words)
        # The ground moves under the first top.
        place = visit.place('/top0')
        visit.wait("window.__viserMutable.nodePoseData['/ground'].position[0] < -0.1")
        assert visit.place('/top0') == place
        ends = visit.page.evaluate("[...document.querySelectorAll('.plot')].slice(1).map("
                                   "plot => plot.dataset.x)")
        assert ends == ['0 6'] * 5
        # The marks follow the scene.
        visit.page.wait_for_function(
            "document.querySelectorAll('.plot .now')[1].getAttribute('transform') > ''"
            " && document.querySelectorAll('.plot .now')[1].getAttribute('transform')"
            " !== 'translate(46 0)'")
        assert visit.errors == []
        assert visit.hosts <= {'', None}
