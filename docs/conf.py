"""The site: sphinx-build -W -b html docs docs/_build (extra ``docs``). Nothing on it is fetched from a network."""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE / "_ext")]
os.environ.setdefault("MPLBACKEND", "agg")
os.environ["PYTHONPATH"] = str(ROOT)

import api_pages  # noqa: E402
import pages  # noqa: E402

from torchchain import __version__  # noqa: E402

project = "torchchain"
author = "The torchchain developers"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery", "pages"]
exclude_patterns = [
    "_build",
    "_ext",
    "concepts",
    "gallery",
    "_generated/**/*.ipynb",
    "_generated/sources",
]
templates_path: list[str] = []
html_theme = "furo"
html_title = f"torchchain {__version__}"
html_static_path: list[str] = []
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"
html_theme_options = {"navigation_with_keys": True}
pygments_style = "friendly"
pygments_dark_style = "native"

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
myst_url_schemes = {"http": None, "https": None, "mailto": None, "doi": "https://doi.org/{{path}}"}

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
add_module_names = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True

api_pages.write_reference(HERE / "_generated" / "api")
pages.write_experiments(ROOT, HERE / "_generated" / "sources")
pages.write_notebooks(ROOT / "notebooks", HERE / "_generated" / "notebooks")
sphinx_gallery_conf = {
    "examples_dirs": [str(HERE / "concepts"), str(HERE / "_generated" / "sources")],
    "gallery_dirs": ["_generated/concepts", "_generated/experiments"],
    "filename_pattern": r"/plot_",  # the concepts are run, the experiments are shown with the figures kept in gallery/
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 1e9,
    "show_signature": False,
    "remove_config_comments": True,
    "reset_modules": ("matplotlib",),
    "image_scrapers": ("matplotlib",),
    "abort_on_example_error": True,
    "copyfile_regex": r".*\.(png|txt)",
    "write_computation_times": False,
}
suppress_warnings = ["config.cache", "ref.python"]  # one attribute name, two classes
