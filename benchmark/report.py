# SPDX-License-Identifier: Apache-2.0
"""Head and tables of the generated pages."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cases import ROOT

MEASURED = ROOT / 'docs/measured'
PACKAGES = 'numpy', 'scipy', 'heyoka', 'matplotlib'


def preamble(title: str, packages: Sequence[str] = PACKAGES) -> str:
    """Return the head of a page: title, command, date, commit, machine and versions."""
    command = ' '.join(['python', os.path.relpath(sys.argv[0], ROOT), *(
        os.path.basename(one) for one in sys.argv[1:])])
    now = datetime.datetime.now(datetime.UTC).strftime('%Y-%m-%d %H:%M UTC')
    return (f'# {title}\n\nWritten by `{command}` on {now}, commit {_commit()}: do not edit.\n\n'
            f'{_processor()}, {os.cpu_count()} cores, {platform.system()}; '
            f'Python {platform.python_version()}, {versions(packages)}.\n')


def versions(packages: Sequence[str] = PACKAGES) -> str:
    """Return the versions of the libraries, or that one is absent."""
    found = []
    for name in packages:
        try:
            found.append(f'{name} {importlib.metadata.version(name)}')
        except importlib.metadata.PackageNotFoundError:
            found.append(f'{name} absent')
    return ', '.join(found)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [heads, ['---'] * len(heads), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines) + '\n'


def number(value: float | None, digits: int = 2) -> str:
    """Return a number in few digits, or a dash for None."""
    return '–' if value is None else f'{value:.{digits}g}'


def write(name: str, text: str) -> None:
    """Write docs/measured/<name>."""
    (MEASURED / name).write_text(text)
    print(f'wrote docs/measured/{name}')


def save(figure: Any, name: str) -> None:
    """Write a picture docs/measured/<name>."""
    if figure.get_layout_engine() is None:
        figure.tight_layout()
    figure.savefig(MEASURED / name, dpi=110)
    print(f'wrote docs/measured/{name}')


# Sections of performance.md in their order; each benchmark writes one of them.
SECTIONS = 'node_cpu', 'startup', 'offline', 'soak'


def write_section(name: str, head: str, description: str, *texts: str) -> None:
    """
    Replace one of the SECTIONS of docs/measured/performance.md by a page.

    description: a docstring; its last paragraph follows the head
    """
    page = '\n'.join((head, description.strip().split('\n\n')[-1] + '\n', *texts))
    path = MEASURED / 'performance.md'
    before = path.read_text() if path.exists() else ''
    sections = dict(re.findall(r'<!-- (\w+) -->\n(.*?)<!-- end -->\n', before, re.DOTALL))
    sections[name] = re.sub('^#', '##', page, flags=re.MULTILINE).strip() + '\n'
    write('performance.md', '\n'.join(['# Performance\n', *(
        f'<!-- {key} -->\n{sections[key]}<!-- end -->\n'
        for key in SECTIONS if key in sections)]))


def _commit() -> str:
    """Return the commit, marked if any file except those that benchmarks write has changed."""
    commit = _git('describe', '--always')
    changed = _git('status', '--porcelain', '--untracked-files=no', '--', '.', ':!docs',
                   ':!README.md')
    return (commit + ('-dirty' if changed else '')) or 'unknown'


def _git(*arguments: str) -> str:
    run = subprocess.run(['git', *arguments], cwd=ROOT, capture_output=True, text=True,
                         check=False)
    return run.stdout.strip()


def _processor() -> str:
    cpuinfo = Path('/proc/cpuinfo')
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith('model name'):
                return line.split(':', 1)[1].strip()
    return platform.processor() or 'unknown processor'
