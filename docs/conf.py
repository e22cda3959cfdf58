"""Configuration of the documentation: ``make docs`` builds it, and fails at any warning."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from sb3_belief import __version__

project = "sb3-belief"
author = "The sb3-belief authors"
copyright = f"2026, {author}"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
default_role = "code"

# One description of each name: where it is public. Types stand in the signature, as in the source
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
add_module_names = False
python_maximum_signature_line_length = 100
# jaxmarl is not needed to build the pages
autodoc_mock_imports = ["jax", "jaxmarl"]

html_theme = "sphinx_rtd_theme"
html_theme_options = {"navigation_depth": 3, "collapse_navigation": False}
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["wide.css"]
