"""Write a notebook as a page with its outputs."""

import os
import re
from pathlib import Path
from typing import Any

import nbformat

FIRST_LINE = re.compile(r"^%.*\n", re.MULTILINE)


def page_of(notebook: Path, folder: Path, *, execute: bool) -> Path:
    """Write NAME.md, and its pictures beside it, into `folder`."""
    content = nbformat.read(notebook, as_version=4)
    if execute:
        from nbclient import NotebookClient

        os.environ["VRW_PROGRESS"] = "0"  # Notices of long calls do not belong into a page.
        NotebookClient(content, timeout=1800, kernel_name="python3").execute()
    parts: list[str] = []
    for cell in content.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        elif cell.cell_type == "code":
            source = FIRST_LINE.sub("", cell.source).strip()
            parts += [f"```python\n{source}\n```"] if source else []
            parts += [_output(output, parts, notebook.stem, folder) for output in cell.outputs]
    title, *rest = parts
    download = f"*[Download the notebook]({notebook.name}).*"
    (folder / notebook.name).write_bytes(notebook.read_bytes())
    page = folder / f"{notebook.stem}.md"
    page.write_text("\n\n".join([title, download, *filter(None, rest)]) + "\n", encoding="utf-8")
    return page


def _output(output: Any, before: list[str], stem: str, folder: Path) -> str:
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```" if output.name == "stdout" else ""
    if output.output_type == "error":
        raise RuntimeError(f"{stem}: {output.ename}: {output.evalue}")
    data = output.data
    for kind, end in (("image/svg+xml", "svg"), ("image/png", "png")):
        if kind in data:
            return _picture(data[kind], end, before, stem, folder)
    if "text/html" in data:
        return f'<div class="output" markdown="0">\n{_join_lines(data["text/html"])}\n</div>'
    return f"```text\n{_join_lines(data['text/plain'])}\n```"


def _picture(data: Any, end: str, before: list[str], stem: str, folder: Path) -> str:
    from base64 import b64decode

    name = f"{stem}_{sum(part.startswith('![') for part in before) + 1}.{end}"
    content = b64decode(data) if end == "png" else _join_lines(data).encode()
    (folder / name).write_bytes(content)
    headings = [found[1] for part in before for found in re.finditer(r"^#+ (.*)$", part, re.M)]
    return f"![{headings[-1] if headings else stem}]({name})"


def _join_lines(text: str | list[str]) -> str:
    return text if isinstance(text, str) else "".join(text)
