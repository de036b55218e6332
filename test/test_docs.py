# SPDX-License-Identifier: Apache-2.0
"""The documents say what the code does."""

import importlib
import os
import re
import runpy
from collections import Counter

import pytest
from helpers import doc_blocks
from helpers.reference import ROOT, SCENES

FOLDERS = 'config', 'docs', 'examples', 'launch', 'rviz', 'scripts', 'test', 'urdf', 'benchmark'

# Pages that programs write or Sphinx copies have no blocks of their own.
PAGES = {str(path.relative_to(ROOT)): path.read_text(encoding='utf-8')
         for path in (ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md')))
         if not path.name.startswith('top_')}
# Why blocks are not run, and how many.
NOT_RUN = {
    'installs packages from the network': 1,
    'the tests have a domain of their own': 1,
    'needs the command line tools of a ROS installation': 7,
    'runs until Ctrl-C, after it has installed packages': 3,
    'takes minutes': 1,
    'needs data that are not part of the package': 1,
    'serves a page until Ctrl-C; test_view_browser.py opens one': 1,
    'a part of a configuration': 1,
}


@pytest.mark.parametrize('name', [name for name, page in PAGES.items()
                                  if any(block.language in ('python', 'bash')
                                         for block in doc_blocks.blocks(page))])
def test_the_code_of_a_page_runs_and_prints_what_it_says(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('COLUMNS', '118')
    runner, said, last = doc_blocks.Runner(name), None, None
    try:
        for block in doc_blocks.blocks(PAGES[name]):
            if block.language == 'text' and block.follows and said is not None:
                if not doc_blocks.agrees(block.text.splitlines(), said.splitlines()):
                    pytest.fail(f'{name}:{last.line} prints\n{said}', pytrace=False)
            else:
                said = None if doc_blocks.left_out(block) else runner.run(block)
                last = block
    finally:
        runner.end()


def test_what_is_not_run_is_counted():
    reasons = Counter(doc_blocks.left_out(block) for page in PAGES.values()
                      for block in doc_blocks.blocks(page) if doc_blocks.left_out(block))
    assert reasons == NOT_RUN


def test_output_that_differs_is_found():
    assert doc_blocks.agrees(['a 1.00 b', '...', 'end'], ['a  1.01 b', 'x', 'y', 'end'])
    assert not doc_blocks.agrees(['a 1.00 b'], ['a 1.10 b'])
    assert not doc_blocks.agrees(['all 1000'], ['all 1001'])
    assert not doc_blocks.agrees(['a 1.00 b'], ['a 1.00 c'])
    assert not doc_blocks.agrees(['a'], ['a', 'b'])


def test_the_interface_page_is_written_from_the_present_code():
    page = runpy.run_path(str(ROOT / 'docs/interface.py'))['page']()
    assert (ROOT / 'docs/interface.md').read_text() == page


def test_the_cost_check_fails_above_the_factor_that_contributing_names(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / 'benchmark')
    check = importlib.import_module('regression')
    text = (ROOT / 'CONTRIBUTING.md').read_text()
    limit = float(*re.findall(r'costs more than (\d\.\d+) times', text))
    right, unknown = [1.0, 1.0, 1.0], [float('nan')] * 3
    for now, parent, release, good in (
            (0.99 * limit, right, right, True), (1.01 * limit, right, unknown, False),
            (1.01 * limit, [2.0] * 3, right, False), (1.01 * limit, right, [2.0] * 3, False)):
        row, found = check.cells('start-up', {
            check.NOW: [now, now, 9.0], check.PARENT: parent, check.RELEASE: release})
        assert found is good and (row[-1] == 'ok') is good, row


def test_architecture_has_every_folder_of_the_package_and_no_name_that_does_not_exist():
    text = (ROOT / 'docs/architecture.md').read_text()
    package = ROOT / 'spinning_top_sim'
    folders = {path.parent.name for path in package.glob('*/__init__.py')}
    heads = re.findall(r'^\| ((?:`\w+/`(?:, )?)+) \|', text, re.MULTILINE)
    assert set(re.findall(r'\w+', ' '.join(heads))) == folders
    text = re.sub(r'^```$.*?^```$', '', text, flags=re.MULTILINE | re.DOTALL)
    named = {word for code in re.findall(r'`([^`]+)`', text)
             for word in re.findall(r'\w+\b(?!\*)', code)}
    paths = [path for folder in (package, *map(ROOT.joinpath, FOLDERS))
             for path in folder.rglob('*') if path.suffix in ('.py', '.md', '')]
    known = {word for path in (*paths, *ROOT.glob('*.py'))
             for word in re.findall(r'\w+', str(path.relative_to(ROOT)))}
    known |= {word for path in package.rglob('*.py')
              for word in re.findall(r'\w+', path.read_text())}
    assert named - known == set()


def test_the_readme_begins_with_the_two_commands_and_a_page_lists_every_scene():
    commands = re.findall(r'^\s*(make \w+)', (ROOT / 'README.md').read_text(), re.MULTILINE)
    assert commands[:2] == ['make run', 'make test']
    text = (ROOT / 'docs/sensor.md').read_text()
    assert all(f'`{scene}`' in text for scene in SCENES)


def test_every_name_that_is_public_can_be_imported():
    page = (ROOT / 'docs/python.md').read_text()
    module, public = None, 0
    for kind, name in re.findall(r'^\.\. (\w+):: (\w[\w.]+)$', page, re.MULTILINE):
        if kind in ('module', 'currentmodule'):
            module = importlib.import_module(name)
        else:
            assert hasattr(module, name), (kind, name)
            public += 1
    assert public > 15


# What is made by `make docs` is left out.
@pytest.mark.parametrize('page', [*ROOT.glob('*.md'), *(
    page for page in ROOT.glob('docs/**/*.md') if not page.name.startswith('top_'))],
    ids=lambda page: page.name)
def test_pages_link_to_what_there_is(page):
    assert '[](' not in page.read_text(), 'empty outside the site'
    for path, anchor in re.findall(r'\]\(((?!https?:)[^)#]+)#?([^)]*)\)', page.read_text()):
        target = page.parent / path
        assert target.exists(), path
        heads = re.findall(r'^#+ (.*)$', target.read_text(), re.MULTILINE) if anchor else ()
        anchors = {re.sub(r'[^\w -]', '', head.lower()).replace(' ', '-') for head in heads}
        assert not anchor or anchor in anchors, (path, anchor)


def test_the_tour_runs_to_its_end_and_is_committed_without_outputs():
    nbclient, nbformat = pytest.importorskip('nbclient'), pytest.importorskip('nbformat')
    pytest.importorskip('ipykernel')
    notebook = nbformat.read(ROOT / 'examples/tour.ipynb', as_version=4)
    assert all(cell.get('outputs', []) == [] for cell in notebook.cells)
    # Its assertions, too: an error in a cell is raised here.
    nbclient.NotebookClient(notebook, timeout=240, kernel_name='python3', resources={
        'metadata': {'path': str(ROOT)}}).execute(
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(
                filter(None, [str(ROOT), os.environ.get('PYTHONPATH')]))})
    outputs = [output for cell in notebook.cells for output in cell.get('outputs', ())]
    pictures = [output for output in outputs if 'image/png' in output.get('data', {})]
    assert len(pictures) == 5
    assert any('cusps' in output.get('text', '') for output in outputs)
    assert any('<div class="animation"' in output.get('data', {}).get('text/html', '')
               for output in outputs)
