"""The documentation as HTML: made without complaint, with a page for each module and each text."""

import ast
import builtins
import graphlib
import importlib
import inspect
import json
import os
import pkgutil
import re
import runpy
import subprocess
import sys
import tokenize
import tomllib
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest

import mjx_revolve
from browser import Browser, needs_browser
from laboratory import ROOT, XLA_FLAGS, need_mjx
from mjx_revolve.inputs.packages import REQUIREMENTS

FOUND = [m.name for m in pkgutil.walk_packages(mjx_revolve.__path__, "mjx_revolve.")]
MODULES = [name for name in FOUND if "._" not in name]


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_has_a_docstring(name):
    if name.endswith("mjx_engine"):
        need_mjx()
    module = importlib.import_module(name)
    assert (module.__doc__ or "").strip()
    for key, value in vars(module).items():
        ours = getattr(value, "__module__", None) == module.__name__ and not key.startswith("_")
        if ours and (inspect.isfunction(value) or inspect.isclass(value)):
            assert (value.__doc__ or "").strip(), key


PACKAGE = ROOT / "mjx_revolve"
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMENTED = [*sorted((ROOT / "configs").glob("*.yaml")), *sorted((ROOT / "morphologies").glob("*"))]


def imports_of(path):
    """Dotted names in the package that a file imports, those for annotations alone left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mjx_revolve"):
            yield node.module
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name.startswith("mjx_revolve"))


def listed_doors():
    """The public subpackages in the order of the reference."""
    text = (ROOT / "docs" / "reference.py").read_text()
    return re.findall(r"\w+", re.search(r"^DOORS = \((.*?)\)", text, re.M | re.S)[1])


def imports_between_layers(layers):
    """Pairs of layers of which the first imports from the second."""
    found = set()
    for layer in layers:
        for path in (PACKAGE / layer).rglob("*.py"):
            others = {name.split(".")[1] for name in imports_of(path) if "." in name}
            found |= {(layer, other) for other in others & {*layers} - {layer}}
    return found


def below(layer, pairs):
    """All layers that a layer imports from, directly or not."""
    found = {b for a, b in pairs if a == layer}
    return found.union(*(below(b, pairs) for b in found))


@pytest.fixture(scope="module")
def architecture():
    return (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def layers(architecture):
    """In the order of the table."""
    return re.findall(r"^\| `(\w+)/` \|", architecture, re.MULTILINE)


def test_layers_import_only_from_layers_above_them(layers):
    assert {*layers} == {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    pairs = imports_between_layers(layers)
    assert len(pairs) > 20
    assert [(a, b) for a, b in pairs if layers.index(a) < layers.index(b)] == []
    assert listed_doors() == [x for x in layers if (PACKAGE / x / "__init__.pyi").is_file()]


def test_the_picture_of_the_layers_is_that_of_their_imports(architecture, layers):
    """No arrow that is not there, and none missing that does not follow from others."""
    drawn = {*re.findall(r"^ +(\w+) --> (\w+)$", architecture, re.MULTILINE)}
    pairs = imports_between_layers(layers)
    assert drawn <= pairs
    for layer in layers:
        assert below(layer, drawn) - {"inputs"} == below(layer, pairs) - {"inputs"}
        # None follows from the others.
        for other in (b for a, b in drawn if a == layer):
            assert other not in below(layer, drawn - {(layer, other)})
        assert ((layer, "inputs") in pairs) == (layer not in ("inputs", "numerics"))


def test_no_layer_has_a_circle_of_imports(layers):
    for layer in layers:
        names = {
            ".".join(path.relative_to(ROOT).with_suffix("").parts): path
            for path in (PACKAGE / layer).rglob("*.py")
        }
        graph = {name: {*imports_of(path)} & {*names} for name, path in names.items()}
        graphlib.TopologicalSorter(graph).prepare()  # raises CycleError


def test_the_tables_of_measures_are_the_codes():
    """Every descriptor, measure and number of a gait in its order, with its unit."""
    from mjx_revolve.body import descriptors
    from mjx_revolve.control import gait
    from mjx_revolve.episodes.measure_table import MEASURES

    text = (ROOT / "docs" / "measures.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", text, re.MULTILINE)
    units = {name: measure.unit for name, measure in MEASURES.items()}
    assert found == [*(descriptors.UNITS | units | gait.UNITS).items()]
    assert {*descriptors.UNITS} <= {*re.findall(r"\w+", descriptors.describe.__doc__)}


@pytest.mark.slow
def test_the_page_of_settings_is_what_the_code_reads():
    """Every task, controller and setting, with what it takes; `make docs` writes it anew."""
    page = runpy.run_path(str(ROOT / "docs" / "settings.py"))["make_page"]()
    text = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert page == text, "run: python docs/settings.py"
    # All that is named in a configuration with everything spelled out has its line.
    for name in ("task.current_std", "controller.gain", "evolution.std_init", "bodies.max_mass"):
        assert f"| `{name}` |" in text


@pytest.mark.parametrize(
    "layer", ["inputs", "body", "genotypes"], ids=lambda layer: f"{layer} without JAX and MuJoCo"
)
def test_layers_do_not_import_what_they_must_not(layer):
    for path in (PACKAGE / layer).rglob("*.py"):
        assert not re.search(r"^\s*(?:import|from) (?:jax|mujoco)", path.read_text(), re.MULTILINE)


def exists(name):
    """Whether a dotted name is a module of ours, or something in one."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


SCRIPTS = [*sorted((ROOT / "examples").glob("*.py"))]
NOTEBOOKS = [*sorted((ROOT / "notebooks").glob("*.ipynb"))]


def text_of(path):
    """The text of a file; of a notebook that of its cells."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    return "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])


@pytest.mark.parametrize("path", [*TEXTS, *SCRIPTS, *NOTEBOOKS], ids=lambda path: path.name)
def test_texts_and_examples_import_public_names_only(path):
    """From the package, a subpackage or a command; never from a module in a subpackage."""
    for module, names in re.findall(
        r"^\s*from (mjx_revolve[\w.]*) import (\([^)]*\)|.*)$", text_of(path), re.MULTILINE
    ):
        assert module.count(".") <= 1, module
        public = importlib.import_module(module)
        for name in re.findall(r"\w+", re.sub(r"#.*| as \w+", "", names)):
            assert name == "main" or name in public.__all__, f"{module}.{name}"


@pytest.mark.parametrize("path", [*TEXTS, *COMMENTED, *NOTEBOOKS], ids=lambda path: path.name)
def test_every_file_and_name_that_a_text_mentions_exists(path):
    """`mjx_revolve/…` and dotted names anywhere; paths of Python files between backticks."""
    text = text_of(path)
    for name in re.findall(r"\bmjx_revolve/[\w/]+\.(?:py|yaml)\b", text):
        assert (ROOT / name).is_file(), name
    for name in re.findall(r"\bmjx_revolve\.\w+(?:\.\w+)*", text):
        assert exists(name), name
    # Their readers write files of their own.
    if path.suffix == ".md" and path.stem not in ("tutorial", "fit"):
        places = (ROOT, PACKAGE, PACKAGE / "view")
        for name in re.findall(r"`((?:\w+/)+\w+\.py)\b", text):
            ours = any((place / name.partition("/")[0]).is_dir() for place in places)
            assert not ours or any((place / name).is_file() for place in places), name


def docstrings(path):
    """All docstrings of a file, with their line."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text


# Names of other programs, whose laws or formats ours follow.
FOREIGN = {
    "Dynamics.cc", "Renderer", "ThrusterConversionFcn.cc", "ThrusterPlugin.cc", "cm_delta",
    "control_joint_rad_to_cl", "cosf", "fluidcoef", "invweight", "joint_position_controller",
    "mj_ellipsoidFluidModel", "mj_inertiaBoxFluidModel", "sinf", "uuv_gazebo_plugins",
}  # fmt: skip


@pytest.fixture(scope="module")
def identifiers():
    """Every name and every word that is a whole string in our Python files."""
    found = {*dir(builtins), *sys.stdlib_module_names, "jax", "numpy", "mujoco"}
    found |= {"NAME", "MODULE"}  # what stands for any name
    for folder in ("mjx_revolve", "tests", "experiments"):
        for path in (ROOT / folder).rglob("*.py"):
            found.add(path.stem)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                match node:
                    case ast.Name(id=name) | ast.arg(arg=name) | ast.Attribute(attr=name):
                        found.add(name)
                    case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                        found.add(name)
                    case ast.alias(name=name):
                        found.update(name.split("."))
                    case ast.keyword(arg=str(name)) | ast.Constant(value=str(name)):
                        found.add(name)
    found |= {path.name for path in PACKAGE.rglob("*")}
    return found | FOREIGN


def test_every_file_and_name_that_a_docstring_mentions_exists(identifiers):
    """Paths and names between backticks; a name need not be in the same file."""
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        places = (ROOT, PACKAGE, path.parent, PACKAGE / "view")
        for line, text in docstrings(path):
            for said in re.findall(r"`([^`\n]+)`", text):
                if re.fullmatch(r"[\w/]+\.py", said):
                    ours = any((place / said.partition("/")[0]).exists() for place in places)
                    known = not ours or any((place / said).is_file() for place in places)
                else:
                    dotted = re.fullmatch(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)(?:\(.*\))?", said)
                    known = dotted is None or said in identifiers
                    known = known or {*dotted[1].split(".")} <= identifiers
                if not known:
                    wrong.append(f"{path.relative_to(ROOT)}:{line}: {said}")
    assert wrong == []


# Things are not persons, one docstring needs no other one, and a gradient is no slope. Words of the
# package's docstrings, comments and messages, and of texts, where users are persons, too.
NOT_PROSE = (
    r"\b(?:nobody|somebody|anybody|told|asked|likewise|finds out|gives up|is let be|tells apart)\b"
    r"|\bas there(?= *[,.;:)]|$)"
)
NOT_CODE = NOT_PROSE + r"|\b(?:who|whom|whose|knows|everybody)\b"
SLOPES = {"bed", "coefficients", "contact", "estimate", "lift_drag", "plates"}  # of a bed, of lift


def prose(path):
    """Lines of the comments and of the strings of a Python file, docstrings among them."""
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            kind = tokenize.tok_name[token.type]
            if kind in ("COMMENT", "STRING", "FSTRING_MIDDLE"):
                for k, line in enumerate(token.string.split("\n")):
                    yield token.start[0] + k, line


def test_things_are_not_persons():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        pattern = NOT_CODE if path.stem in SLOPES else NOT_CODE + r"|\bslopes?\b"
        wrong += [
            (path, number, x) for number, line in prose(path) for x in re.findall(pattern, line)
        ]
    for path in [*TEXTS, *sorted((ROOT / "configs").glob("*.yaml"))]:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            wrong += [(path, number, x) for x in re.findall(NOT_PROSE, line)]
    assert [f"{path.relative_to(ROOT)}:{number}: {x}" for path, number, x in wrong] == []


def run_script(name, *arguments):
    """What a script of `docs/` prints."""
    command = [sys.executable, str(ROOT / "docs" / name), *map(str, arguments)]
    place = XLA_FLAGS | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | place)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of pages, with one robot in its gallery."""
    pytest.importorskip("pdoc", reason="the reference is made by pdoc")
    folder = tmp_path_factory.mktemp("docs")
    run_script("gallery.py", folder, "--only", "core")
    done = run_script("reference.py", folder)
    assert done.stderr == "" and done.stdout.endswith(f"open {folder / 'index.html'}\n")
    return folder


def test_the_gallery_has_every_robot_and_every_task():
    """At least thirty pages; champions are whole, and of shipped configurations."""
    from mjx_revolve.episodes import TASKS, load_config
    from mjx_revolve.inputs.shipped import list_shipped

    names = runpy.run_path(str(ROOT / "docs" / "gallery.py"))["list_names"]()
    assert sum(map(len, names.values())) >= 30
    assert names["robots"] == [*list_shipped("morphologies")]
    configs = [load_config(ROOT / "docs" / "champions" / x / "config.yaml") for x in names["tasks"]]
    assert {config.task.type for config in configs} == {*TASKS}
    for name, config in zip(names["tasks"], configs, strict=True):
        assert config.task.type == load_config(name).task.type
        assert (ROOT / "docs" / "champions" / name / "champion" / "genes.yaml").is_file()


@pytest.mark.long
def test_the_reference_has_every_public_name_and_no_private_module(site):
    doors = ["mjx_revolve", *(f"mjx_revolve.{door}" for door in listed_doors())]
    for door in doors:
        path = site / f"{door.replace('.', '/')}.html"
        text = path.read_text()
        for name in set(importlib.import_module(door).__all__) - {"__version__"}:
            section = text.partition(f'<section id="{name}">')[2].partition("</section>")[0]
            assert 'class="docstring"' in section, f"{door}.{name}"
    assert len([*site.rglob("mjx_revolve/**/*.html")]) == len(doors) - 1


class Links(HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self, path):
        super().__init__()
        self.links, self.anchors = [], {"", "top"}
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("href", "src"):
                self.links.append(value)
            elif name in ("id", "name"):
                self.anchors.add(value)


@pytest.mark.slow
def test_every_link_leads_somewhere(site):
    """To a file of the site, and an anchor in it; nothing but links for people leads elsewhere."""
    pages = {path: Links(path) for path in site.rglob("*.html")}
    count = 0
    for path, page in pages.items():
        html = path.read_text(encoding="utf-8")
        assert not re.search(r'(?:src|rel="stylesheet" href)="http', html), path.name
        for link in page.links:
            if link.startswith(("http:", "https:", "data:", "mailto:")):
                continue
            target, _, anchor = link.partition("#")
            found = (path.parent / unquote(target)).resolve() if target else path
            assert found.is_file(), f"{path.name}: {link}"
            if found.suffix == ".html":
                assert unquote(anchor) in pages[found].anchors, f"{path.name}: {link}"
            count += 1
    assert count > 2000
    assert {path.stem for path in TEXTS[1:]} <= {path.stem for path in pages}
    assert {path.stem for path in NOTEBOOKS} <= {path.stem for path in pages}
    # Names of our texts are links.
    assert '<a href="physics.html"><code>docs/physics.md</code></a>' in (
        (site / "index.html").read_text()
    )


@pytest.mark.slow
@needs_browser
def test_a_page_of_the_gallery_moves_without_an_error(site):
    with Browser() as browser:
        browser.open(site / "gallery" / "core.html", "#plain")
        browser.wait("document.documentElement.dataset.time > 0.3")
        assert browser.fact("error") is None and browser.errors == []
        assert all(address.startswith("file:") for address in browser.requests)


def test_messages_name_what_can_be_installed():
    """This package is on no index, so that its extras cannot be named there."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    known = {name for extra in project["optional-dependencies"].values() for name in extra}
    texts = [p.read_text("utf-8") for p in [*(ROOT / "docs").glob("*.md"), ROOT / "README.md"]]
    texts += [p.read_text("utf-8") for p in (ROOT / "mjx_revolve").rglob("*.py")]
    named = {x for text in texts for x in re.findall(r"pip install[ \"\n]*'([^'{]+)'", text)}
    named |= {*REQUIREMENTS.values()}
    assert len(named) == 8 and named <= known
