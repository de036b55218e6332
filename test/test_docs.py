# SPDX-License-Identifier: Apache-2.0
"""
The documents say what the code does: their code blocks are run, page by page.

The blocks of a page run in order, in one empty folder and one Python namespace.

- `python` blocks are executed, unless their first line is a comment with the name of a file, such
  as `# my_filter.py`: then they are written to that file.  So are `yaml` blocks.
- `bash` blocks are run by bash.  `<!-- background -->` in the line before keeps one running until
  the page ends; `<!-- exit code 1 -->` expects another than 0; `<!-- not run: REASON -->` leaves
  one out.
- A `text` block right behind a block that ran is its output.  Integers are equal, other numbers
  agree within 2 %, and a line `...` stands for any lines.
"""

import contextlib
import io
import json
import math
import os
import re
import runpy
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from helpers.reference import ROOT

# Pages that Sphinx copies have no blocks of their own.
PAGES = [path for path in (*ROOT.glob('*.md'), *sorted(ROOT.glob('docs/**/*.md')))
         if not path.name.startswith('top_')]
FENCE = re.compile(r'^(?:<!-- (?P<mark>[^\n]*?) -->\n)?'
                   r'^```(?P<language>[^\n]*)\n(?P<text>.*?)^```$', re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r'(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?(?![\w])')
FILE = re.compile(r'# ([\w/]+\.(?:py|yaml))\n')
TIMEOUT = 600        # of a block [s], also under load


class Block(NamedTuple):
    """A fenced block: its language, text, first line in the page, mark, and what is before it."""

    language: str
    text: str
    line: int
    mark: str
    follows: bool       # directly behind the block before


def blocks(page):
    """Return the blocks of a page, those of Sphinx (`{...}`) left out."""
    found, end = [], 0
    for match in FENCE.finditer(page):
        language = match['language'] or 'text'
        if not language.startswith('{'):
            found.append(Block(language, match['text'], page[:match.start()].count('\n') + 1,
                               match['mark'] or '', not page[end:match.start()].strip()))
        end = match.end()
    return found


def same(expected, actual):
    """Return whether two lines are the same but for the last digits of numbers."""
    if NUMBER.sub('#', ' '.join(expected.split())) != NUMBER.sub('#', ' '.join(actual.split())):
        return False
    return all(one == other or (not one.isdecimal() and math.isclose(
        float(one), float(other), rel_tol=0.02)) for one, other in
        zip(NUMBER.findall(expected), NUMBER.findall(actual), strict=True))


def agrees(expected, actual):
    """Return whether lines of output are those of a page, where `...` stands for any lines."""
    if not expected or not actual:
        return all(line.strip() == '...' for line in expected) and not actual
    if expected[0].strip() == '...':
        return any(agrees(expected[1:], actual[skipped:]) for skipped in range(len(actual) + 1))
    return same(expected[0], actual[0]) and agrees(expected[1:], actual[1:])


class Runner:
    """Runs the blocks of a page in a folder, which is the working directory."""

    def __init__(self, name):
        self._name, self._namespace = name, {'__name__': '__main__'}
        self.running = contextlib.ExitStack()
        for folder in ('config', 'examples', 'urdf'):
            Path(folder).symlink_to(ROOT / folder)
        # Executables, and the package where it is not installed.
        paths = (str(Path(sys.executable).parent), str(ROOT / 'scripts'), os.environ['PATH'])
        self._environment = {**os.environ, 'PATH': os.pathsep.join(paths),
                             'PYTEST_DISABLE_PLUGIN_AUTOLOAD': '1',
                             'PYTHONPATH': os.pathsep.join(filter(None, (
                                 os.environ.get('PYTHONPATH'), str(ROOT))))}

    def run(self, block):
        """Run a block; return what it printed, None if it is no code."""
        named = FILE.match(block.text)
        if block.language in ('python', 'yaml') and named:
            path = Path(named[1])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding='utf-8')
            return None
        if block.language == 'python':
            said = io.StringIO()
            with contextlib.redirect_stdout(said):
                exec(compile('\n' * block.line + block.text, self._name, 'exec'), self._namespace)
            return said.getvalue()
        if block.language == 'bash':
            return self._shell(block)
        return None

    def _shell(self, block):
        line = ['bash', '-euo', 'pipefail', '-c', block.text]
        if block.mark == 'background':
            self.running.callback(_ended, subprocess.Popen(
                line, stdin=subprocess.DEVNULL, start_new_session=True, env=self._environment))
            return None
        done = subprocess.run(line, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, check=False,
                              stderr=subprocess.STDOUT, text=True, timeout=TIMEOUT,
                              env=self._environment)
        expected = block.mark.removeprefix('exit code ') or '0'
        assert str(done.returncode) == expected, f'{self._name}:{block.line}: {done.stdout}'
        return done.stdout


def _ended(process):
    """End a group of processes as Ctrl-C does."""
    os.killpg(process.pid, signal.SIGINT)
    process.wait(TIMEOUT)


@pytest.mark.parametrize('page', [page for page in PAGES if any(
    block.language in ('python', 'bash') for block in blocks(page.read_text()))],
    ids=lambda page: page.name)
def test_the_code_of_a_page_runs_and_prints_what_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('COLUMNS', '118')
    runner, said, last = Runner(page.name), None, None
    with runner.running:
        for block in blocks(page.read_text()):
            if block.language == 'text' and block.follows and said is not None:
                if not agrees(block.text.splitlines(), said.splitlines()):
                    pytest.fail(f'{page.name}:{last.line} prints\n{said}', pytrace=False)
            else:
                said = None if block.mark.startswith('not run: ') else runner.run(block)
                last = block


def test_the_interface_page_is_written_from_the_present_code():
    page = runpy.run_path(str(ROOT / 'docs/interface.py'))['page']()
    assert (ROOT / 'docs/interface.md').read_text() == page


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_pages_link_to_what_there_is(page):
    """Sphinx checks the site; these links are those of the repository's pages."""
    for path, anchor in re.findall(r'\]\(((?!https?:)[^)#]+)#?([^)]*)\)', page.read_text()):
        target = page.parent / path
        assert target.exists(), path
        heads = re.findall(r'^#+ (.*)$', target.read_text(), re.MULTILINE) if anchor else ()
        assert not anchor or anchor in {
            re.sub(r'[^\w -]', '', head.lower()).replace(' ', '-') for head in heads}, anchor


def test_the_tour_runs_to_its_end_and_is_committed_without_outputs(capsys):
    """Its assertions, too; its code alone, without a kernel."""
    pyplot, shown = pytest.importorskip('matplotlib.pyplot'), []
    cells = [cell for cell in json.loads((ROOT / 'examples/tour.ipynb').read_text())['cells']
             if cell['cell_type'] == 'code']
    assert not any(cell['outputs'] for cell in cells)
    pyplot.switch_backend('agg')
    namespace = {'HTML': shown.append}
    for cell in cells:
        exec(''.join(line for line in cell['source']
                     if not line.startswith(('%', 'from IPython'))), namespace)
    assert len(pyplot.get_fignums()) == 4
    pyplot.close('all')
    assert 'cusps' in capsys.readouterr().out and '<div class="animation"' in shown[0]
