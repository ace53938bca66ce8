"""The imports of the package, read as text, keep to the table of docs/architecture.md."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "src" / "freegeo"
ANYWHERE = {"types", "errors", "host", "files", "lock", "run_folder", "__init__"}
ALLOWED = {
    "job": {
        *("models", "data", "adaptation", "evidence", "fusion", "export", "report"),
        *("pipeline", "guarded", "refined", "posed", "metres", "cameras"),
    },
    "sequence_job": {
        *("models", "data", "adaptation", "evidence", "export", "report", "sequence"),
        *("job", "pipeline", "guarded", "posed", "metres", "cameras"),
    },
    "runs": {
        *("models", "data", "adaptation", "export", "sequence"),
        *("job", "sequence_job", "pipeline", "posed", "metres", "cameras"),
    },
    "sequence_api": {
        *("models", "data", "adaptation", "evidence", "export", "fusion", "sequence", "progress"),
        *("runs", "job", "pipeline", "posed", "cameras"),
    },
    "pipeline": {
        *("models", "data", "adaptation", "evidence", "export", "progress"),
        *("guarded", "taught", "posed", "metres", "cameras"),
    },
    "posed": {"cameras", "data", "evidence", "export", "geometry", "models"},
    "metres": {"cameras", "data", "export", "geometry"},
    "guarded": {"adaptation", "evidence", "export"},
    "refined": {"data", "evidence", "export", "fusion", "guarded", "models"},
    "taught": {"adaptation", "evidence", "export", "geometry", "guarded"},
    "progress": {"adaptation"},
    "benchmark": {"adaptation", "models", "data", "fusion", "metrics", "geometry", "pools"},
    "sequence": {"evidence", "models", "fusion", "geometry"},
    "webapp": {"adaptation", "data", "export", "models", "progress", "report"},
    "training": {"models", "data", "metrics", "geometry"},
    "adaptation": {"models", "data.scene", "geometry"},
    "evidence": {"export", "fusion", "metrics", "geometry"},
    "report": {"evidence", "export", "metrics", "geometry"},
    "export": {"data.image_files", "fusion", "geometry"},
    "fusion": {"geometry"},
    "metrics": {"data.scene", "geometry"},
    "data": {"geometry"},
    "cameras": {"data", "evidence", "export", "geometry"},
    "models": {"data.image_files", "geometry"},
    "pools": set(),
    "geometry": set(),
    "types": set(),
    "errors": set(),
    "host": set(),
    "files": set(),
    "lock": set(),
    "run_folder": set(),
    "__init__": set(),
}
HEAVY = {
    "peft", "scipy", "cv2", "trimesh", "matplotlib", "huggingface_hub", "mcubes", "av", "pycolmap", "viser",
    "transformers", "jinja2", "ray", "open3d", "pillow_heif", "OpenEXR", "rerun", "gradio", "fastapi", "starlette",
    "uvicorn",
}  # fmt: skip
FILES = sorted(PACKAGE.rglob("*.py"))


def name_of(file: Path) -> str:
    return file.relative_to(PACKAGE).as_posix()


@cache
def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def imported(node: ast.AST) -> list[str]:
    """Return the full names that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative import"
        return [f"{node.module}.{alias.name}" for alias in node.names]
    return []


def at_import_time(tree: ast.Module) -> Iterator[ast.AST]:
    """Walk what runs when a module is imported: no function bodies, nothing that only a type checker sees."""
    waiting: list[ast.AST] = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            waiting.extend(node.orelse)
            continue
        yield node
        waiting.extend(ast.iter_child_nodes(node))


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def entered(file: Path) -> set[str]:
    """Return the parts of the package that a file imports, wherever in the file; types count too."""
    own = [name for node in ast.walk(tree_of(file)) for name in imported(node) if name.split(".")[0] == "freegeo"]
    return {".".join(name.split(".")[1:]) for name in own if "." in name}


def may_enter(room: str, target: str) -> bool:
    head = target.split(".")[0]
    if head in ANYWHERE or head.startswith("__") or head == room:
        return True
    return any(target == allowed or target.startswith(f"{allowed}.") for allowed in ALLOWED[room])


def test_every_room_has_a_rule():
    assert {room_of(file) for file in FILES} <= set(ALLOWED) | {"cli"}


@pytest.mark.parametrize("file", [f for f in FILES if room_of(f) != "cli"], ids=name_of)
def test_rooms_are_entered_as_allowed(file):
    wrong = {target for target in entered(file) if not may_enter(room_of(file), target)}
    assert not wrong


def test_nobody_imports_the_command_line():
    assert not [name_of(f) for f in FILES if room_of(f) != "cli" and any(t.startswith("cli") for t in entered(f))]


@pytest.mark.parametrize("file", FILES, ids=name_of)
def test_heavy_packages_are_imported_where_they_are_used(file):
    at_once = {name.split(".")[0] for node in at_import_time(tree_of(file)) for name in imported(node)}
    assert at_once.isdisjoint(HEAVY), sorted(at_once & HEAVY)


@pytest.mark.parametrize("file", [f for f in FILES if room_of(f) != "cli"], ids=name_of)
def test_only_commands_print(file):
    calls = [node for node in ast.walk(tree_of(file)) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    assert not [call.lineno for call in calls if call.func.id == "print"]


def test_the_rule_finds_what_breaks_it():
    """The checks above are only worth something if they see a forbidden import."""
    assert not may_enter("models", "data.photos")
    assert not may_enter("adaptation", "data.photos")
    assert may_enter("adaptation", "data.scene.Scene")
    assert may_enter("benchmark", "metrics.pose")
    tree = ast.parse(
        "import scipy\nif TYPE_CHECKING:\n    import cv2\ndef f():\n    import peft\nclass C:\n    import av\n"
    )
    assert {name for node in at_import_time(tree) for name in imported(node)} == {"scipy", "av"}


DOORS = {"Image.open": "data/image_files.py", "av.open": "data/video.py", "trimesh.load": "fusion/mesh.py"}
"""Readers that start programs, or open other files and addresses, unless they are limited: each is called once."""


def calls_of(name: str, tree: ast.Module) -> int:
    """Count the calls of a function that reads; with the mode "w" it writes."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and ast.unparse(node.func).startswith(name)]
    return sum(not any(isinstance(value, ast.Constant) and value.value == "w" for value in call.args) for call in calls)


@pytest.mark.parametrize("name", DOORS)
def test_files_from_elsewhere_are_opened_in_one_place(name):
    assert {name_of(file): n for file in FILES if (n := calls_of(name, tree_of(file)))} == {DOORS[name]: 1}


WRITERS = {
    "write_text", "write_bytes", "mkdir", "makedirs", "touch", "unlink", "rmdir", "rmtree", "rename", "move", "symlink",
    "symlink_to", "hardlink_to", "link", "copyfile", "copy2", "copytree", "truncate", "chmod", "mkdtemp", "mkstemp",
    "NamedTemporaryFile", "TemporaryDirectory", "extractall", "savez", "savez_compressed", "savetxt", "tofile",
    "imwrite", "save_file", "savefig",
}  # fmt: skip
FROM_A_DOOR = {"part", "buffer", "stream"}
"""What the temporary paths of files.py are called, and files in memory."""
WRITES = {
    **dict.fromkeys(("files.py", "lock.py", "run_folder.py"), "the doors themselves"),
    # Files and folders whose paths atomic_files, atomic_folder or scratch_folder gave
    "adaptation/samples.py": 3, "benchmark/download.py": 5, "export/depth_files.py": 5, "export/nerfstudio.py": 3,
    "export/photos.py": 5,
    # Lines that are added while something runs
    "cli/batch.py": 1, "pools.py": 1, "training/loop.py": 1,
    # Places of their own: the cache of weights, the folder of the app
    "models/hub.py": 5, "webapp/runs.py": 2, "webapp/sessions.py": 13,
    # Bytes in memory; no file at all
    "export/glb.py": 1, "cli/console.py": 2,
}  # fmt: skip
"""Where files are changed otherwise than through files.py, and how often."""


def changes_files(call: ast.Call) -> bool:
    """Whether a call makes, changes or removes a file, other than one from a door."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    values = [*call.args, *(keyword.value for keyword in call.keywords)]
    texts = [value.value for value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)]
    changes = (
        name in WRITERS
        or (name == "open" and any(len(text) < 4 and set("wax+") & set(text) for text in texts))
        or (name == "replace" and len(call.args) == 1 and not call.keywords)
        or (name == "export" and any(keyword.arg == "file_type" for keyword in call.keywords))
        # The rest are methods of our own, such as Reconstruction.save.
        or (ast.unparse(call.func) in ("np.save", "torch.save"))
        or (name == "save" and isinstance(call.func, ast.Attribute) and len(values) > 1)
    )
    return changes and not any(isinstance(node, ast.Name) and node.id in FROM_A_DOOR for node in ast.walk(call))


@pytest.mark.parametrize("file", FILES, ids=name_of)
def test_writers_go_through_the_doors(file):
    """A new writer takes its path from files.py, as atomic_path gives it; any other has to be looked at, and listed."""
    calls = [node for node in ast.walk(tree_of(file)) if isinstance(node, ast.Call) and changes_files(node)]
    allowed = WRITES.get(name_of(file), 0)
    assert isinstance(allowed, str) or len(calls) == allowed, [f"{call.lineno}: {ast.unparse(call)}" for call in calls]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("path.write_text('x')", True), ("part.write_text('x')", False), ("(part / 'a').write_text('x')", False),
        ("path.open('wb')", True), ("open(path, mode='a')", True), ("path.open('rb')", False), ("path.open()", False),
        ("np.save(path, x)", True), ("np.save(part, x)", False), ("image.save(path, 'PNG')", True),
        ("image.save(buffer, 'PNG')", False), ("result.save(folder)", False), ("a.replace(b)", True),
        ("text.replace('a', 'b')", False), ("replace(value, name=1)", False), ("os.unlink(path)", True),
    ],
)  # fmt: skip
def test_the_rule_about_writers_finds_them(text, found):
    call = ast.parse(text).body[0].value
    assert changes_files(call) == found
