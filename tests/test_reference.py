"""The reference names every public name of every package, each once, and nothing else."""

import re
from importlib import import_module
from pathlib import Path

import pytest

import ccdtools

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"
PAGES = {page.stem: page.read_text(encoding="utf-8") for page in REFERENCE.glob("*.md") if page.stem != "index"}
PAGES["ccdtools"] += PAGES["ccdtools_codesign"]
PACKAGES = [
    "ccdtools",
    "ccdtools.studies",
    "invariant_sets",
    "mpc",
    "mpc.optimal_control",
    "mpc.optimal_control.estimation",
    "learning",
]


def documented(text: str) -> list[tuple[str, str, str]]:
    """Module, directive and name of everything that a page documents."""
    found, module = [], ""
    pattern = r"^\.\. (currentmodule|auto(?:class|exception|function)):: (\S+)$"
    for directive, name in re.findall(pattern, text, flags=re.M):
        module = name if directive == "currentmodule" else module
        found += [] if directive == "currentmodule" else [(module, directive.removeprefix("auto"), name)]
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_the_page_of_a_package_documents_its_public_names(package):
    found = documented(PAGES[package.rpartition(".")[2]])
    assert sorted(name for module, _, name in found if module == package) == sorted(import_module(package).__all__)


def test_the_page_of_ccdtools_documents_the_names_of_its_groups_that_it_has_not_itself():
    found = sorted((module, name) for module, _, name in documented(PAGES["ccdtools"]) if module != "ccdtools")
    groups = [f"ccdtools.{group}" for group in ccdtools.GROUPS]
    assert found == sorted(
        (group, name) for group in groups for name in import_module(group).__all__ if name not in ccdtools.__all__
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_what_a_page_calls_a_class_is_one(package):
    for module, directive, name in documented(PAGES[package.rpartition(".")[2]]):
        thing = getattr(import_module(module), name)
        kind = "function" if not isinstance(thing, type) else "exception" if issubclass(thing, Exception) else "class"
        assert directive == kind, name
