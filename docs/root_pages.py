"""A hook of mkdocs: pages outside docs/ join the site, and links between all pages lead to where they stand there."""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "robot_client/README.md": "robot_client.md",
}
SOURCES = {page: source for source, page in PAGES.items()}
LINK = re.compile(r"(\]\()([^)#\s:]+)((?:#[^)\s]*)?\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository that lie outside docs/, and the sources that pages lead to."""
    root = Path(config.docs_dir).parent
    for source, page in {**dict(linked_sources(root)), **PAGES}.items():
        files.append(File.generated(config, page, content=(root / source).read_text()))
    return files


def linked_sources(root: Path) -> Iterator[tuple[str, str]]:
    """Files of the repository, neither pages nor in docs/, that a page links to; the site has them at their path."""
    for page in [*root.glob("docs/**/*.md"), *(root / source for source in PAGES)]:
        for _, link, _ in LINK.findall(page.read_text()):
            target = posixpath.normpath(posixpath.join(page.parent.relative_to(root).as_posix(), link))
            if not target.startswith("docs/") and (root / target).is_file():
                yield target, target


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Rewrite links, which are right in the repository, so that they are right in the site."""
    here = page.file.src_uri
    folder = posixpath.dirname(SOURCES.get(here, f"docs/{here}"))

    def moved(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        in_site = PAGES.get(target, target.removeprefix("docs/"))
        return link[1] + posixpath.relpath(in_site, posixpath.dirname(here) or ".") + link[3]

    return LINK.sub(moved, markdown)
