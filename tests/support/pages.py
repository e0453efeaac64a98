"""What the pages of the docs hold: README, CONTRIBUTING and all below docs/."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tree import ROOT

PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/**/*.md")])
_FENCE = re.compile(r"^```([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#{1,6} (.+)$", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    kind: str
    text: str

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks() -> list[Block]:
    """Return the fenced blocks of all pages."""
    return [
        Block(page, text.count("\n", 0, found.start()) + 1, found[1], found[2])
        for page in PAGES
        for text in [page.read_text()]
        for found in _FENCE.finditer(text)
    ]


def commands(program: str) -> dict[str, list[str]]:
    """Return the command lines of a program that fenced blocks show: their words, by place."""
    found = {}
    for block in blocks():
        lines = block.text.replace("\\\n", " ").splitlines() if not block.kind else []
        for number, line in enumerate(lines):
            if match := re.match(rf"(?:[A-Z_]+=\S+ )?{re.escape(program)} ([^#]*)", line):
                found[f"{block.name}+{number}"] = match[1].split()
    return found


def prose(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return _FENCE.sub("", page.read_text())


def links(page: Path) -> list[str]:
    """Return where a page's links and pictures within the repository lead."""
    found = _LINK.findall(prose(page))
    return [target for target in found if not re.match(r"[a-z]+:", target)]


def anchors(page: Path) -> set[str]:
    """Return the ids that a page's headings have in repository browsers and on the site."""
    slugs = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in _HEADING.findall(prose(page)))
    return {slug.strip().replace(" ", "-") for slug in slugs}
