"""The reference names every public name of every package, each once, and nothing else."""

import re
from importlib import import_module
from pathlib import Path

import pytest

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"
PAGES = {page.stem: page.read_text(encoding="utf-8") for page in REFERENCE.glob("*.md") if page.stem != "index"}
PACKAGES = ["ccdtools", "ccdtools.studies", "invariant_sets", "mpc", "mpc.optimal_control", "learning"]


def documented(text: str) -> list[tuple[str, str]]:
    """Directive and name of everything that a page documents."""
    return re.findall(r"^\.\. auto(class|exception|function):: (\w+)$", text, flags=re.M)


@pytest.mark.parametrize("package", PACKAGES)
def test_the_page_of_a_package_documents_its_public_names(package):
    text = PAGES[package.rpartition(".")[2]]
    assert set(re.findall(r"^\.\. currentmodule:: (\S+)$", text, flags=re.M)) == {package}
    assert sorted(name for _, name in documented(text)) == sorted(import_module(package).__all__)


@pytest.mark.parametrize("package", PACKAGES)
def test_what_a_page_calls_a_class_is_one(package):
    for directive, name in documented(PAGES[package.rpartition(".")[2]]):
        thing = getattr(import_module(package), name)
        kind = "function" if not isinstance(thing, type) else "exception" if issubclass(thing, Exception) else "class"
        assert directive == kind, name
