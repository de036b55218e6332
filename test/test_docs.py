# SPDX-License-Identifier: Apache-2.0
"""The documents say what the code does."""

import importlib
import re
import runpy

from helpers.reference import ROOT, SCENES

FOLDERS = 'config', 'docs', 'examples', 'launch', 'rviz', 'scripts', 'test', 'urdf', 'benchmark'


def test_the_interface_page_is_written_from_the_present_code():
    page = runpy.run_path(str(ROOT / 'docs/interface.py'))['page']()
    assert (ROOT / 'docs/interface.md').read_text() == page


def test_architecture_has_every_folder_of_the_package_and_no_name_that_does_not_exist():
    text = (ROOT / 'docs/architecture.md').read_text()
    package = ROOT / 'spinning_top_sim'
    folders = {path.parent.name for path in package.glob('*/__init__.py')}
    assert set(re.findall(r'^\| `(\w+)/` \|', text, re.MULTILINE)) == folders
    text = re.sub(r'^```$.*?^```$', '', text, flags=re.MULTILINE | re.DOTALL)
    named = {word for code in re.findall(r'`([^`]+)`', text) for word in re.findall(r'\w+', code)}
    paths = [path for folder in (package, *map(ROOT.joinpath, FOLDERS))
             for path in folder.rglob('*') if path.suffix in ('.py', '.md', '')]
    known = {word for path in (*paths, *ROOT.glob('*.py'))
             for word in re.findall(r'\w+', str(path.relative_to(ROOT)))}
    known |= {word for path in package.rglob('*.py')
              for word in re.findall(r'\w+', path.read_text())}
    assert named - known == set()


def test_the_readme_begins_with_the_two_commands_and_lists_every_scene():
    text = (ROOT / 'README.md').read_text()
    commands = re.findall(r'^\s*(make \w+)', text, re.MULTILINE)
    assert commands[:2] == ['make run', 'make test']
    assert all(f'`{scene}`' in text for scene in SCENES)


def test_every_name_that_is_public_can_be_imported():
    page = (ROOT / 'docs/versioning.md').read_text()
    public = re.findall(r'`(spinning_top_sim(?:\.\w+)+)`', page)
    assert len(public) > 5
    for name in public:
        module, _, attribute = name.rpartition('.')
        assert hasattr(importlib.import_module(module), attribute), name


def test_the_documents_of_the_repository_link_to_what_there_is():
    for name in ('CONTRIBUTING.md', 'QUALITY_DECLARATION.md', 'SECURITY.md', 'docs/versioning.md'):
        page = ROOT / name
        for path, anchor in re.findall(r'\]\(((?!https?:)[^)#]+)#?([^)]*)\)', page.read_text()):
            target = page.parent / path
            assert target.exists(), (name, path)
            heads = re.findall(r'^#+ (.*)$', target.read_text(), re.MULTILINE) if anchor else ()
            anchors = {re.sub(r'[^\w -]', '', head.lower()).replace(' ', '-') for head in heads}
            assert not anchor or anchor in anchors, (name, path, anchor)
