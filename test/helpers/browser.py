# SPDX-License-Identifier: Apache-2.0
"""A page in headless Chromium: what it shows, says and asks for."""

import re
import shutil
import urllib.parse
from pathlib import Path

import pytest

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


def launch():
    """Yield a browser; skip the tests where there is none."""
    if CHROMIUM is None:
        pytest.skip('NO CHROMIUM: THE PAGE IS NOT TESTED; apt-get install chromium')
    playwright = pytest.importorskip('playwright.sync_api')
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        yield browser
        browser.close()


class Visit:
    """A page that is open; knows its errors and the hosts that it asked."""

    def __init__(self, browser, address, *, offline=False, framed=False):
        self._context = browser.new_context(
            viewport={'width': 320, 'height': 400}, offline=offline)
        self._context.add_init_script(NOT_DRAWN)
        self.page = self._context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.errors, self.hosts = [], set()
        self.page.on('pageerror', lambda error: self.errors.append(str(error)))
        self.page.on('console', lambda message: message.type == 'error'
                     and self.errors.append(message.text))
        for event in ('request', 'websocket'):
            self.page.on(event, lambda asked: self.hosts.add(
                urllib.parse.urlsplit(asked.url).hostname))
        self.page.goto(address if '://' in address else Path(address).as_uri())
        self.scene = self.page.frames[1] if framed else self.page
        self.wait("window.__viserMutable?.nodePoseData['/top/body']")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._context.close()

    def wait(self, condition):
        """Wait until a JavaScript expression is true; return it."""
        return self.scene.wait_for_function(condition, timeout=PATIENCE_MS).json_value()

    def attitude(self, name='/top/body'):
        """Return the quaternion x, y, z, w with which a node of the scene is drawn."""
        w, *xyz = self.scene.evaluate(f'window.__viserMutable.nodePoseData[{name!r}].wxyz')
        return [*xyz, w]

    def place(self, name):
        """Return the position of a node of the scene."""
        return self.scene.evaluate(f'window.__viserMutable.nodePoseData[{name!r}].position')

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

    def tick(self, label):
        self.page.get_by_label(label, exact=True).click()
