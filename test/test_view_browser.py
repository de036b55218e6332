# SPDX-License-Identifier: Apache-2.0
"""The page as headless Chromium shows it, live and as a file: what it draws, says and asks for."""

import re
import shutil
import signal
import urllib.parse
from pathlib import Path

import numpy as np
import pytest
from helpers.node_harness import SimNode, wait_for
from scipy.spatial.transform import Rotation

from spinning_top_sim.tools import simulate
from spinning_top_sim.view import command

pytest.importorskip('viser')
CHROMIUM = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome'))), None)
PATIENCE_MS = 60_000
# WebGL by software.
OPTIONS = ('--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
           '--enable-unsafe-swiftshader')
# Shaders are made and the scene is moved, but no pixel is computed: the processor would need ten
# seconds for the first picture.  Five pictures a second are enough to be looked at by a program.
NOT_DRAWN = """for (const name of ['drawArrays', 'drawElements', 'drawElementsInstanced'])
    WebGL2RenderingContext.prototype[name] = () => {};
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = act => setTimeout(() => draw(act), 200);"""
VIEW = ('-m', 'spinning_top_sim', 'view', '--no-browser', '--port', '0')


@pytest.fixture(scope='module')
def browser():
    if CHROMIUM is None:
        pytest.skip('NO CHROMIUM: THE PAGE IS NOT TESTED; apt-get install chromium')
    playwright = pytest.importorskip('playwright.sync_api')
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        yield browser
        browser.close()


class Visit:
    """A page that is open; it must raise no error, and ask this machine only."""

    def __init__(self, browser, address, *, offline=False):
        self._context = browser.new_context(
            viewport={'width': 320, 'height': 400}, offline=offline)
        self._context.add_init_script(NOT_DRAWN)
        self.page = self._context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self._errors, self._hosts = [], set()
        self.page.on('pageerror', lambda error: self._errors.append(str(error)))
        self.page.on('console', lambda message: message.type == 'error'
                     and self._errors.append(message.text))
        for event in ('request', 'websocket'):
            self.page.on(event, lambda asked: self._hosts.add(
                urllib.parse.urlsplit(asked.url).hostname or ''))
        self.page.goto(address if '://' in address else Path(address).as_uri())
        self.scene = self.page.frames[1] if offline else self.page
        self.wait("window.__viserMutable?.nodePoseData['/top/body']")

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        self._context.close()
        assert kind or (self._errors == [] and self._hosts <= {'127.0.0.1', ''})

    def wait(self, condition):
        """Wait until a JavaScript expression is true; return it."""
        return self.scene.wait_for_function(condition, timeout=PATIENCE_MS).json_value()

    def attitude(self):
        """Return the quaternion x, y, z, w with which the body is drawn."""
        w, *xyz = self.scene.evaluate("window.__viserMutable.nodePoseData['/top/body'].wxyz")
        return [*xyz, w]

    def read(self, pattern):
        """Wait for a text; return its groups."""
        self.page.wait_for_function('text => RegExp(text).test(document.body.innerText)',
                                    arg=pattern)
        found = re.search(pattern, self.page.inner_text('body'))
        return found and found.groups()

    def press(self, name):
        self.page.get_by_role('button', name=name, exact=True).click()

    def put(self, label, value):
        """Type a value into the box beside a slider."""
        box = self.page.locator(f'xpath=//label[.="{label}"]/ancestor::div[contains(@class, '
                                '"Flex-root")][1]//input[@inputmode="decimal"]')
        box.fill(str(value))
        box.press('Enter')

    def choose(self, label, option):
        """Choose from a drop-down by keys: its list scrolls while a mouse moves to an option."""
        box = self.page.get_by_label(label, exact=True).first
        box.fill(option)
        self.page.get_by_role('option', name=option, exact=True).wait_for()
        box.press('ArrowDown')
        box.press('Enter')


def address_of(node):
    return wait_for('the address', lambda: re.search(r'http://[\w.:]+', node.out)).group()


def test_a_simulation_without_a_node(browser, tmp_path):
    """Its sliders, buttons and scenes are what the browser shows next."""
    own = SimNode(tmp_path, program=(*VIEW, '--scene', 'looping'))
    del own.command[own.command.index('--ros-args'):]
    with own:
        with Visit(browser, address_of(own)) as visit:
            visit.read('Scene looping; the title names the motion')
            visit.wait("document.title === 'spinning top'")
            visit.wait("document.querySelectorAll('.plot polyline').length >= 7")
            visit.press('Pause')
            visit.press('Reset')
            visit.read(r't = 0\.000 s, stamp 1\.0')
            visit.put('tilt θ [deg]', 60)
            turned = Rotation.from_euler('y', 60, degrees=True).as_quat()
            wait_for('the start', lambda: np.allclose(visit.attitude(), turned, atol=1e-6))
            visit.press('Step')
            visit.read(r't = 0\.020 s')
            visit.page.get_by_label('torque', exact=True).click()
            visit.wait("[...document.querySelectorAll('.top-legend')].some("
                       "e => e.textContent.includes('torque'))")
            visit.choose('scene', 'shuttle')
            visit.read('The pivot moves')       # a click meanwhile closes the list of scenes
            visit.press('Play')
            visit.wait("window.__viserMutable.nodePoseData['/ground'].position[0] < 0")
        assert own.end(signal.SIGTERM) == 0, own.err


def test_a_file_without_a_network(browser, tmp_path):
    page, log = tmp_path / 'page.html', tmp_path / 'run.mcap'
    assert simulate.main(['--duration', '6', '-o', str(log), '--command', '2.5:2.0:1.5']) == 0
    assert command.main([str(log), '--html', str(page)]) == 0
    assert page.stat().st_size < 2e6        # for 6 s
    with Visit(browser, str(page), offline=True) as visit:
        # Before the first picture, and where it begins again, viser turns nothing.
        wait_for('a picture', lambda: visit.attitude() != [0, 0, 0, 1])
        for words in ('run.mcap', 'trace of the axis', 'Energy', 'Effective potential'):
            visit.read(words)
        visit.read(r'Cusps(\n.*)*t = [01]\.\d* s, stamp [12]\.')
        visit.read(r'Loops(\n.*)*t = [3-5]\.\d* s, stamp [4-6]\.')
        visit.page.wait_for_function(       # the potential of one motion, and marks
            "document.querySelectorAll('.potential:not([hidden])').length === 1 && "
            "document.querySelector('.plot:last-child .now').getAttribute('transform')"
            " !== 'translate(46 0)'")
