"""What README and the pages print can be run: every Python block of a page, in order, and every command line.

Every link leads somewhere, and pages for people are short, in short sentences, with pictures.
"""

import re
import runpy
import shlex
from pathlib import Path

import pytest
import typer
from matplotlib.figure import Figure

from ccdtools.cli import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
FOR_PEOPLE = [p for p in PAGES if p.parent.name in {"start", "how_to", "explanation", "gallery"} and p.stem != "index"]
PICTURES = sorted((DOCS / "pictures").glob("[a-z]*.py"))
BLOCK = re.compile(r"```python\n(.*?)```", re.S)  # what is printed, and nothing else
WRITTEN = re.compile(r"```sh\n(.*?)```", re.S)
INLINE = re.compile(r"`((?:ccdtools|python|make) [^`…]+)`")
LONG = [  # co-designs; a policy and a twin that are trained
    "codesign.md", "compare.md", "deploy_and_update.md", "every_stage_alone.md", "imitate_mpc.md", "objectives.md",
    "ten_minutes.md",
]  # fmt: skip
HEAVY = dict.fromkeys(LONG, pytest.mark.check)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
RUN = [page for page in PAGES if page.name != "README.md" and BLOCK.search(page.read_text(encoding="utf-8"))]
DRAWS = {script: re.findall(r'run\("(.+?)"\)', script.read_text(encoding="utf-8")) for script in PICTURES}
DRAWN = {DOCS / page for pages in DRAWS.values() for page in pages}
HERE = [page for page in RUN if not (page.name in LONG and page in DRAWN)]  # pictures of those run all their blocks


def name(page: Path) -> str:
    """A page as the root of the project sees it."""
    return page.relative_to(ROOT).as_posix()


@pytest.mark.long
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("page", [pytest.param(p, id=name(p), marks=HEAVY.get(p.name, ())) for p in HERE])
def test_every_python_block_of_a_page_runs_in_order(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict = {}
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        before = "\n" * text[: block.start()].count("\n")  # an error names the line of the page
        exec(compile(f"{before}\n{block[1]}", str(page), "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_no_page_hides_what_its_code_needs(page):
    assert "<!--" not in page.read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """What the headings of a page can be linked by, on GitHub and on the site."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.+)$", text, flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_every_link_of_a_page_leads_to_a_file_and_a_heading(page):
    dead = []
    for link in LINK.findall(re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if link.startswith(("https://", "mailto:")):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            dead.append(link)
    assert dead == []


@pytest.mark.parametrize("page", FOR_PEOPLE, ids=name)
def test_a_page_for_people_is_short_and_has_a_picture(page):
    text = page.read_text(encoding="utf-8")
    assert text.count("\n") <= 150
    pictures = [page.parent / link for link in LINK.findall(text) if link.endswith(".png")]
    assert pictures
    assert all(picture.stat().st_size < 150_000 for picture in pictures)


@pytest.mark.parametrize("page", FOR_PEOPLE, ids=name)
def test_a_page_for_people_has_short_sentences(page):
    long = [sentence for sentence in sentences(page.read_text(encoding="utf-8")) if len(sentence.split()) > 40]
    assert long == []


def test_pages_for_people_are_few_words_together():
    apart = {"reference", "benchmarks"}
    pages = [page for page in PAGES if page.name != "CONTRIBUTING.md" and page.parent.name not in apart]
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in pages) <= 12_000


def sentences(text: str) -> list[str]:
    """The sentences of a page: code, headings and links' targets left out, a row's cells and list items apart."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    prose = re.sub(r"^\s*(#.*|\|[-|: ]+)$", "", re.sub(r"\]\([^)]*\)", "]", prose), flags=re.M)
    return re.split(r"(?<=[.!?:;])\s+|\n\s*\n|\n(?=\s*(?:[-*|]|\d+\.))|\|", prose)


@pytest.mark.check
@pytest.mark.usefixtures("brief")
@pytest.mark.parametrize("script", PICTURES, ids=name)
def test_every_picture_is_what_its_script_draws(script, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.syspath_prepend(script.parent)  # `_page.py` stands beside it
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **options: drawn.append((figure, Path(path))))
    runpy.run_path(str(script), run_name="__main__")
    ((figure, path),) = drawn
    assert path == script.with_suffix(".png")
    assert path.exists()
    assert any(axes.has_data() for axes in figure.axes)


def commands() -> list[tuple[str, str]]:
    """Every command line of the pages with the name of its page, comments left out."""
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        lines = [line for block in WRITTEN.findall(text) for line in block.splitlines()] + INLINE.findall(text)
        found += [(name(page), line.split("  #")[0].strip()) for line in lines if line.strip()]
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
