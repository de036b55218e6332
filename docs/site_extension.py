# SPDX-License-Identifier: Apache-2.0
"""
What the site needs of Sphinx beyond its own extensions.

- `{help-of} NAME` is what the command says with `--help`.
- Files at the top of the repository, such as the changelog, get a page docs/top_*; links of other
  pages lead to it.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

from docutils import nodes
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

logger = logging.getLogger(__name__)

WIDTH = 88
# Pages made from files at the top of the repository, where these exist.
PAGES = 'CONTRIBUTING.md', 'SECURITY.md', 'QUALITY_DECLARATION.md', 'CHANGELOG.rst'


class HelpOf(SphinxDirective):
    """`{help-of} NAME`."""

    required_arguments = 1

    def run(self):
        """Return the help of the executable as a literal block."""
        script = self.config.site_root / 'scripts' / self.arguments[0]
        self.env.note_dependency(str(script))
        paths = os.pathsep.join(filter(None, (str(self.config.site_root),
                                              os.environ.get('PYTHONPATH'))))
        done = subprocess.run([sys.executable, script, '--help'], check=False, text=True,
                              capture_output=True, timeout=120,
                              env={**os.environ, 'COLUMNS': str(WIDTH), 'PYTHONPATH': paths,
                                   'NO_COLOR': '1'})
        if done.returncode:     # rosdoc2 goes on where rclpy is missing
            logger.warning('%s --help: %s', script.name, done.stderr.strip(),
                           location=self.get_location())
        told = done.stdout or done.stderr
        return [nodes.literal_block(told, told, language='none')]


def write_pages(app):
    """Write a page for each file of PAGES that there is."""
    root = app.config.site_root
    for name in PAGES:
        page = Path(app.srcdir) / f'top_{name.lower()}'
        if not (root / name).is_file():
            page.unlink(missing_ok=True)
            continue
        text = (root / name).read_text(encoding='utf-8')
        if name.endswith('.md'):        # links from the top
            text = re.sub(r'\]\((?:docs/?|README\.md(?:#[^)]*)?)\)', '](index.rst)', text)
            text = re.sub(r'\]\((?!docs/|index\.rst|[a-z]+:|#)', '](../', text)
            text = text.replace('](docs/', '](')
        if not page.exists() or page.read_text(encoding='utf-8') != text:
            page.write_text(text, encoding='utf-8')


def lead_to_pages(app, name, source):
    """Turn links to the files of PAGES into links to their pages."""
    for page in PAGES:
        source[0] = source[0].replace(f'](../{page}', f'](top_{page.lower()}')


def setup(app):
    """Register all this."""
    app.add_config_value('site_root', Path(app.confdir).parent, 'env')
    app.add_directive('help-of', HelpOf)
    app.connect('builder-inited', write_pages)
    app.connect('source-read', lead_to_pages)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
