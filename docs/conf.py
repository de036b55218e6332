# SPDX-License-Identifier: Apache-2.0
"""
The site: `make docs`, or `sphinx-build docs SITE` where the package can be imported.

Building and reading it need no network.  rosdoc2, which copies this folder and brings Sphinx with
a theme of its own, builds it too.
"""

import importlib.util
import os
import sys
from pathlib import Path
from xml.etree import ElementTree

HERE = Path(__file__).resolve().parent
# rosdoc2 has copied this folder, changed the working directory, and keeps the path of the package
# in its arguments only.
ROOT = next(folder for folder in (HERE.parent, *(
    Path(os.environ.get('PWD', '.'), word.rpartition('=')[2]).resolve() for word in sys.argv[1:]))
    if (folder / 'spinning_top_sim/__init__.py').is_file())
sys.path[:0] = [str(HERE), str(ROOT)]
site_root = ROOT


def installed(name):
    """Return whether a module can be imported."""
    return importlib.util.find_spec(name) is not None


project = 'spinning_top_sim'
author = copyright = 'The spinning_top_sim maintainers'
release = ElementTree.parse(ROOT / 'package.xml').findtext('version')
version = release

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'site_extension',
              'numpydoc' if installed('numpydoc') else 'sphinx.ext.napoleon']
if installed('sphinx-mathjax-offline'):
    extensions.append('sphinx-mathjax-offline')     # formulas without the network
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
# The latter two are what rosdoc2 adds.
exclude_patterns = ['_*', 'modules.rst', 'spinning_top_sim*']
# Types of other packages: a link to them would need the network.
nitpick_ignore_regex = [('py:.*', r'(numpy|np|pathlib|collections|argparse|NDArray|ArrayLike|'
                                  r'npt|scipy|os|contextlib)(\..*)?')]
suppress_warnings = ['config.cache']

myst_enable_extensions = ['dollarmath', 'amsmath', 'deflist', 'attrs_block']
myst_heading_anchors = 3

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
autodoc_preserve_defaults = True
numpydoc_show_class_members = False
# Parameters and yields are described, with their types; what is returned, by the first sentence
# or by a section.
numpydoc_validation_checks = {'PR01', 'PR02', 'PR03', 'PR04', 'PR07', 'RT03', 'YD01'}
# Made by solvers; a protocol; what others describe or extend; fields that have comments.
numpydoc_validation_exclude = {
    r'\.States$', r'\.Filter$', r'\.Filter\.update$', r'\.Body$', r'\.Start$',
    r'\.Description$', r'\.LogTopic$', r'\.LogMessage$', r'\.Scene$'}

html_theme = 'furo' if installed('furo') else 'alabaster'
html_title = f'{project} {release}'
html_copy_source = False
html_show_sphinx = False
html_static_path = ['_static']
html_css_files = ['site.css']
highlight_language = 'none'
pygments_style = 'friendly'

# Without it rosdoc2 adds the Markdown parser a second time, and links to sites of ROS.
rosdoc2_settings = {'support_markdown': False, 'enable_intersphinx': False,
                    'automatically_extend_intersphinx_mapping': False}
