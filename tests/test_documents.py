"""What README and the guides print can be run: every Python block of a page, in order, and every command line."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from ccdtools.cli import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"```python\n(.*?)```", re.S)  # what is printed, and nothing else
WRITTEN = re.compile(r"```sh\n(.*?)```", re.S)
INLINE = re.compile(r"`((?:ccdtools|python|make) [^`…]+)`")
HEAVY = {"codesign.md": pytest.mark.slow}  # every method, ten starts
RUN = [page for page in PAGES if page.name != "README.md" and BLOCK.search(page.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("page", [pytest.param(p, id=p.name, marks=HEAVY.get(p.name, ())) for p in RUN])
def test_every_python_block_of_a_page_runs_in_order(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict = {}
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        before = "\n" * text[: block.start()].count("\n")  # an error names the line of the page
        exec(compile(f"{before}\n{block[1]}", str(page), "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_page_hides_what_its_code_needs(page):
    assert "<!--" not in page.read_text(encoding="utf-8")


def commands() -> list[tuple[str, str]]:
    """Every command line of the pages with the name of its page, comments left out."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        lines = [line for block in WRITTEN.findall(text) for line in block.splitlines()] + INLINE.findall(text)
        found += [(page.name, line.split("  #")[0].strip()) for line in lines if line.strip()]
    return found


@pytest.mark.parametrize(("page", "line"), sorted(set(commands())))
def test_every_command_line_of_a_page_is_one_and_short_ones_run(page, line, tmp_path, monkeypatch):
    program, *words = shlex.split(line, comments=True)
    if program == "ccdtools":
        group = typer.main.get_command(app)
        name, command, rest = group.resolve_command(group.make_context("ccdtools", words), words)
        command.make_context(name, rest, resilient_parsing=not rest)  # a command alone is its name in a sentence
        monkeypatch.chdir(tmp_path)
        app(words if name == "studies" or (name == "new" and rest) else [name, "--help"], standalone_mode=False)
    elif program == "make":
        targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
        assert words[0] in targets
    elif program == "python":
        place = Path(words[1].replace(".", "/") + ".py") if words[0] == "-m" else Path(words[0])
        assert any((folder / place).is_file() for folder in (ROOT, ROOT / "benchmarks"))
    else:
        assert program in {"cd", "pip"}, line
