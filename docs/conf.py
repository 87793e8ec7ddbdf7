"""Sphinx builds the site of these pages: `make docs`. Code hosts also show these Markdown pages."""

from __future__ import annotations

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

project = "Rover router"
html_title = project
copyright = "the rover router's authors"  # noqa: A001 - Sphinx's name
extensions = ["myst_parser", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["pictures/*"]
smartquotes = False

# MyST's own function gives the same anchors as code hosts; tests/test_docs.py compares them.
myst_heading_anchors = 4

# An example may leave out irrelevant parts (`...`), which its language does not allow.
suppress_warnings = ["misc.highlighting_failure"]
highlight_language = "text"

html_theme = "furo"
pygments_style, pygments_dark_style = "github-light-high-contrast", "github-dark"
html_logo = html_favicon = "site/logo.svg"
html_static_path = ["site"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
templates_path: list[str] = []
_LIGHT = {"color-brand-primary": "#0047b3", "color-brand-content": "#0047b3", "color-brand-visited": "#0047b3"}
_DARK = {"color-brand-primary": "#8ab4ff", "color-brand-content": "#8ab4ff", "color-brand-visited": "#8ab4ff"}
html_theme_options = {
    "light_css_variables": _LIGHT,
    "dark_css_variables": _DARK,
    "navigation_with_keys": True,
}

# The copy button copies only commands, without prompts.
copybutton_prompt_text = r"\$ |> "
copybutton_prompt_is_regexp = True
copybutton_line_continuation_character = "\\"


def setup(app: Sphinx) -> None:
    app.add_lexer("hex", TextLexer)
