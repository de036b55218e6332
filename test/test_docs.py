# SPDX-License-Identifier: Apache-2.0
"""The documents say what the code does."""

import re
import runpy

from helpers.reference import ROOT, SCENES


def test_the_interface_page_is_written_from_the_present_code():
    page = runpy.run_path(str(ROOT / 'docs/interface.py'))['page']()
    assert (ROOT / 'docs/interface.md').read_text() == page


def test_architecture_names_every_module_and_example_and_no_other():
    text = (ROOT / 'docs/architecture.md').read_text()
    named = set(re.findall(r'`(?:\w+/)*(\w+\.py)`', text))
    modules = {path.name for path in (ROOT / 'spinning_top_sim').rglob('*.py')
               if path.name != '__init__.py'}
    tests = {path.name for path in (ROOT / 'test').glob('*.py')}
    examples = {path.name for path in (ROOT / 'examples').glob('*.py')}
    assert named - tests <= modules | examples
    parts = {name for name in modules if name.startswith(('exact_', 'theta_', 'long_', 'errors'))}
    assert not (modules | examples) - named - parts


def test_the_readme_begins_with_the_two_commands_and_lists_every_scene():
    text = (ROOT / 'README.md').read_text()
    commands = re.findall(r'^\s*(make \w+)', text, re.MULTILINE)
    assert commands[:2] == ['make run', 'make test']
    assert all(f'`{scene}`' in text for scene in SCENES)
