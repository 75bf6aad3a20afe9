"""How the pages and the docstrings become one site: `make docs` builds it into out/docs, warnings as errors."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_site")]

import avtorch  # noqa: E402

project = "avtorch"
author = "avtorch contributors"
copyright = author
version = release = avtorch.__version__

extensions = [
    # Markdown, and notebooks
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "cyclopts.ext.sphinx",
    # in _site: pages made from the packages, pages as a code host shows them, notebooks, pictures drawn by a page's own
    # code, formulas without a script
    "reference",
    "code_host",
    "notebook_pages",
    "gallery",
    "mathml",
]
exclude_patterns = ["_site"]

# Pages are plain Markdown, so that a code host shows them as they are meant.
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
myst_url_schemes = {"http": None, "https": None, "mailto": None, "source": {"url": "{{path}}"}}
highlight_language = "none"

# Notebooks are kept with their outputs (`make notebooks`).
nb_execution_mode = "off"

# Docstrings: prose with `names` in single backticks, "Args:" blocks, LaTeX in math roles.
default_role = "py:obj"
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
# a line may name several attributes
napoleon_custom_sections = [("Attributes", "params_style")]
smartquotes = False
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"avtorch {version}"
html_static_path = ["_site/static"]
html_css_files = ["avtorch.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
