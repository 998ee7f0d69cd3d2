"""Sphinx settings; the pages also read well as plain Markdown."""

from testbed import __version__

project = "ncs-testbed"
copyright = "the ncs-testbed contributors"
version = release = __version__
extensions = ["myst_parser"]
root_doc = "contents"
exclude_patterns = ["_build"]
myst_heading_anchors = 3
html_theme = "alabaster"
html_theme_options = {"page_width": "1300px", "description": "State estimation over lossy networks"}
