"""Checkpoints load strictly, whatever their container; what does not fit or is damaged gives one clear sentence."""

import argparse
import json
import struct
import sys
from collections import OrderedDict
from pathlib import Path
from types import ModuleType

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

TESTS = Path(__file__).parents[1]
sys.path.append(str(TESTS))  # the parity modules are shared with the full parity run and lie beside this folder

import parity_da3  # noqa: E402
import parity_vggt  # noqa: E402
from freegeo.errors import UserError  # noqa: E402
from freegeo.models import catalog, da3_config, vggt_config  # noqa: E402
from freegeo.models.checkpoints import find_file, fingerprint, read_header, require_fit, save_weights  # noqa: E402
from freegeo.models.spec import ModelEntry  # noqa: E402

DA3 = TESTS / "fixtures" / "da3" / "tiny-mlp"
VGGT = TESTS / "fixtures" / "vggt" / "tiny-smallvar"
GAUSSIAN_HEAD, TRACKING_HEAD = 35_628_486, 65_941_396
FINAL_NORM = "backbone.pretrained.norm.weight"


@pytest.fixture(autouse=True)
def small_models(monkeypatch):
    """Put the two small models into the catalog, under the rules of the official files."""
    small_da3 = ModelEntry(
        name="small-da3", about="", licence="none", parameters=0, keys=da3_config.KEYS,
        build=lambda: parity_da3.empty_model(DA3),
    )  # fmt: skip
    small_vggt = ModelEntry(
        name="small-vggt", about="", licence="none", parameters=0, keys=vggt_config.KEYS,
        build=lambda: parity_vggt.empty_model(VGGT),
    )  # fmt: skip
    monkeypatch.setattr(da3_config, "ENTRIES", (*da3_config.ENTRIES, small_da3))
    monkeypatch.setattr(vggt_config, "ENTRIES", (*vggt_config.ENTRIES, small_vggt))


def load(name: str, path: Path):
    return catalog.load_model(name, checkpoint=path)


def save(path: Path, tensors: dict[str, torch.Tensor]) -> Path:
    if path.suffix == ".pt":
        torch.save(tensors, path)
    else:
        save_file({name: value.clone() for name, value in tensors.items()}, path)
    return path


def one_sentence_about(error, *parts: str) -> bool:
    text = str(error.value)
    return "\n" not in text and len(text) < 500 and all(part in text for part in parts)


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
@pytest.mark.parametrize(("name", "folder"), [("small-da3", DA3), ("small-vggt", VGGT)])
def test_both_containers_load_to_the_same_frozen_model(tmp_path, name, folder, suffix):
    stored = load_file(folder / "weights.safetensors")
    model = load(name, save(tmp_path / f"copy{suffix}", stored))
    state = model.state_dict()
    assert {key.removeprefix("model.") for key in stored} <= state.keys()
    assert all(torch.equal(state[key.removeprefix("model.")], value.float()) for key, value in stored.items())
    assert not any(p.requires_grad for p in model.parameters()) and not model.training
    assert model.loaded_from.licence == "none" and len(model.loaded_from.fingerprint) == 16


def is_loaded(name: str, folder: Path, path: Path) -> bool:
    """Say whether a file gives the model of `folder`."""
    state, wanted = load(name, path).state_dict(), load(name, folder / "weights.safetensors").state_dict()
    return all(torch.equal(value, state[key]) for key, value in wanted.items())


@pytest.mark.parametrize(
    "content",
    [
        lambda state: {"model": state, "epoch": torch.tensor(3)},
        lambda state: {"state_dict": state, "epoch": 3, "optimizer_states": [{"state": {}}]},
        lambda state: {"model_state_dict": state},
        lambda state: {"module": state, "lr_scheduler": None},
        lambda state: {"model": state, "args": argparse.Namespace(lr=1.0, name="run")},
        lambda state: {"state_dict": {"model": state}},
        lambda state: {"state_dict": {f"model.{name}": value for name, value in state.items()}},
        lambda state: OrderedDict(state),
    ],
)
def test_weights_in_a_training_checkpoint_are_found(tmp_path, content):
    torch.save(content(load_file(VGGT / "weights.safetensors")), tmp_path / "run.pt")
    assert is_loaded("small-vggt", VGGT, tmp_path / "run.pt")


def test_other_weights_in_the_file_are_mentioned(tmp_path, caplog):
    state = load_file(VGGT / "weights.safetensors")
    torch.save({"ema": {name: value * 2 for name, value in state.items()}, "model": state}, tmp_path / "run.pt")
    assert is_loaded("small-vggt", VGGT, tmp_path / "run.pt")
    assert "the weights under 'model' are used; the file also holds 'ema'" in caplog.text


@pytest.mark.parametrize(
    "wrapped",
    [
        "module.{}", "_orig_mod.{}", "_orig_mod.module.{}", "module.model.{}", "model._fsdp_wrapped_module.{}",
        "system.network.{}",
    ],
)  # fmt: skip
@pytest.mark.parametrize(("name", "folder"), [("small-da3", DA3), ("small-vggt", VGGT)])
def test_names_of_a_wrapped_model_are_unwrapped(tmp_path, name, folder, wrapped):
    tensors = {wrapped.format(k): v for k, v in load_file(folder / "weights.safetensors").items()}
    assert is_loaded(name, folder, save(tmp_path / "m.safetensors", tensors))


def test_a_wrapper_inside_the_model_is_taken_out(tmp_path):
    tensors = load_file(DA3 / "weights.safetensors")
    inside = {name.replace("pretrained.", "pretrained._orig_mod."): value for name, value in tensors.items()}
    assert inside.keys() != tensors.keys()
    assert is_loaded("small-da3", DA3, save(tmp_path / "m.safetensors", inside))


def test_tensors_beside_a_wrapped_model_are_refused_by_name(tmp_path):
    tensors = {f"student.{name}": value for name, value in load_file(VGGT / "weights.safetensors").items()}
    path = save(tmp_path / "m.safetensors", {**tensors, "loss.weight": torch.ones(2)})
    with pytest.raises(UserError, match=r"fit small-vggt: 1 unexpected \(first: loss\.weight\)\."):
        load("small-vggt", path)


def test_a_tensor_that_is_there_twice_is_refused(tmp_path):
    tensors = load_file(VGGT / "weights.safetensors")
    first = next(iter(tensors))
    path = save(tmp_path / "m.safetensors", {**tensors, f"module.{first}": tensors[first] * 2})
    with pytest.raises(UserError, match=f"holds {first} twice, as .*{first} and as"):
        load("small-vggt", path)


@pytest.mark.parametrize("suffix", [".pt", ".pth", ".bin", ".ckpt"])
@pytest.mark.parametrize("in_zip", [True, False])
def test_pickles_old_and_new_load_under_every_usual_name(tmp_path, suffix, in_zip):
    path = tmp_path / f"weights{suffix}"
    torch.save(load_file(VGGT / "weights.safetensors"), path, _use_new_zipfile_serialization=in_zip)
    assert is_loaded("small-vggt", VGGT, path)


def sharded(folder: Path, ending: str) -> Path:
    """Write the small VGGT in two parts with an index; returns the index."""
    folder.mkdir()
    tensors = load_file(VGGT / "weights.safetensors")
    stem = "model" if ending == ".safetensors" else "pytorch_model"
    place = {name: f"{stem}-0000{1 + k % 2}-of-00002{ending}" for k, name in enumerate(tensors)}
    for file in set(place.values()):
        part = {name: value for name, value in tensors.items() if place[name] == file}
        save_file(part, folder / file) if ending == ".safetensors" else torch.save(part, folder / file)
    index = folder / f"{stem}{ending}.index.json"
    index.write_text(json.dumps({"metadata": {}, "weight_map": place}))
    return index


@pytest.mark.parametrize("ending", [".safetensors", ".bin"])
def test_a_checkpoint_in_parts_loads_from_its_folder_its_index_and_any_part(tmp_path, ending):
    index = sharded(tmp_path / "parts", ending)
    for given in (index.parent, index, next(index.parent.glob("*-00002-of-00002.*"))):
        assert find_file(given) == index
    assert is_loaded("small-vggt", VGGT, index.parent)
    require_fit(catalog.build_empty("small-vggt"), index, vggt_config.KEYS, "small-vggt")


def test_parts_have_a_fingerprint_together(tmp_path):
    index = sharded(tmp_path / "parts", ".safetensors")
    before = fingerprint(index)
    assert before == fingerprint(sharded(tmp_path / "again", ".safetensors"))
    part = next(index.parent.glob("*-00002-of-00002.*"))
    save_file({name: value + 1 for name, value in load_file(part).items()}, part)
    assert fingerprint(index) != before


def test_parts_that_are_missing_are_named(tmp_path):
    index = sharded(tmp_path / "parts", ".safetensors")
    first, second = sorted(index.parent.glob("*.safetensors"))
    tensors = load_file(second)
    moved = tensors.pop(next(iter(tensors)))
    save_file(tensors, second)
    with pytest.raises(UserError, match=r"00002-of-00002\.safetensors: 1 tensors of .*index\.json are missing"):
        load("small-vggt", index.parent)
    with pytest.raises(UserError, match="1 missing"):
        require_fit(catalog.build_empty("small-vggt"), index, vggt_config.KEYS, "small-vggt")
    save_file({**tensors, "surplus": moved}, second)
    second.unlink()
    with pytest.raises(UserError, match=r"00002-of-00002\.safetensors: this part of the checkpoint is missing"):
        load("small-vggt", index)
    index.write_text("[]")
    with pytest.raises(UserError, match="not the index of a checkpoint"):
        load("small-vggt", index)
    index.unlink()
    for given in (first, first.parent):
        with pytest.raises(UserError, match=r"whose index model\.safetensors\.index\.json is missing"):
            load("small-vggt", given)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_weights_of_other_precisions_are_converted(tmp_path, dtype):
    tensors = {name: value.to(dtype) for name, value in load_file(VGGT / "weights.safetensors").items()}
    path = save(tmp_path / "m.safetensors", tensors)
    assert all(value.dtype == torch.float32 for value in load("small-vggt", path).state_dict().values())
    require_fit(catalog.build_empty("small-vggt"), path, vggt_config.KEYS, "small-vggt")


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
@pytest.mark.parametrize("dtype", [torch.float8_e4m3fn, torch.float8_e5m2, torch.int8, torch.uint8])
def test_weights_that_need_scales_are_refused(tmp_path, dtype, suffix):
    tensors = load_file(VGGT / "weights.safetensors")
    tensors = {name: value.to(dtype) if value.ndim > 1 else value for name, value in tensors.items()}
    path = save(tmp_path / f"m{suffix}", tensors)
    with pytest.raises(UserError, match="which needs scales that freegeo does not read") as error:
        load("small-vggt", path)
    assert one_sentence_about(error, str(path), str(dtype).removeprefix("torch."), "Use weights in float32")
    with pytest.raises(UserError, match="which needs scales"):
        require_fit(catalog.build_empty("small-vggt"), path, vggt_config.KEYS, "small-vggt")


def header_of(text: str) -> bytes:
    return struct.pack("<Q", len(text.encode())) + text.encode() + bytes(40)


@pytest.mark.parametrize(
    "content",
    [
        b"", b"abc", struct.pack("<Q", 1 << 40) + bytes(40), struct.pack("<Q", 4) + b"\xff\xfe{}", header_of("[1]"),
        header_of('{"a": 1}'), header_of('{"a": {"dtype": "F32", "shape": [10]}}'),
        header_of('{"a": {"dtype": "X32", "shape": [10], "data_offsets": [0, 40]}}'),
        header_of('{"a": {"dtype": "F32", "shape": [-10], "data_offsets": [0, 40]}}'),
        header_of('{"a": {"dtype": "F32", "shape": [9], "data_offsets": [0, 40]}}'),
        header_of('{"a": {"dtype": "F32", "shape": [10], "data_offsets": [8, 48]}}'),
    ],
)  # fmt: skip
def test_damaged_headers_are_refused(tmp_path, content):
    path = tmp_path / "m.safetensors"
    path.write_bytes(content)
    for read in (lambda: load("small-vggt", path), lambda: read_header(path)):
        with pytest.raises(UserError) as error:
            read()
        assert one_sentence_about(error, str(path), "ownload")


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 5\n", "a pointer of Git LFS"),
        (b"<!DOCTYPE html><html>Log in</html>", "a web page, not weights"),
        (b"not weights at all, but some words", "not a "),
    ],
)
def test_text_in_the_place_of_weights_is_named(tmp_path, suffix, content, words):
    path = tmp_path / f"model{suffix}"
    path.write_bytes(content)
    with pytest.raises(UserError, match=words) as error:
        load("small-vggt", path)
    assert one_sentence_about(error, str(path))


@pytest.mark.parametrize(
    ("name", "folder"), [("small-da3", VGGT), ("small-vggt", DA3), ("vggt-1b", VGGT), ("da3-small", DA3)]
)
def test_checkpoint_of_another_model_is_refused(name, folder):
    with pytest.raises(UserError, match="does not fit") as error:
        load(name, folder / "weights.safetensors")
    assert one_sentence_about(error, name, "first: ", "--checkpoint", "weights.safetensors")


@pytest.mark.parametrize("prefix", ["model.", ""])
@pytest.mark.parametrize("with_aliases", [False, True])
def test_prefix_and_aliases_may_be_there_or_not(tmp_path, prefix, with_aliases):
    tensors = {k.removeprefix("model."): v for k, v in load_file(DA3 / "weights.safetensors").items()}
    aliases = da3_config.KEYS.aliases
    assert len(aliases) == 6 and not aliases.keys() & tensors.keys()
    if with_aliases:
        tensors |= {alias: tensors[stored] for alias, stored in aliases.items()}
    model = load("small-da3", save(tmp_path / "m.safetensors", {prefix + k: v for k, v in tensors.items()}))
    norms = [branch[2] for branch in model.head.scratch.output_conv2_aux]
    assert all(torch.equal(norm.weight, norms[0].weight) for norm in norms)
    assert not torch.equal(norms[3].weight, torch.ones_like(norms[3].weight))


@pytest.mark.parametrize(
    ("name", "folder", "extra"),
    [("small-da3", DA3, "model.gs_head.weight"), ("small-vggt", VGGT, "track_head.tracker.query_ref_token")],
)
def test_parts_that_are_not_built_are_skipped_by_name_and_nothing_else_is(tmp_path, name, folder, extra):
    tensors = load_file(folder / "weights.safetensors")
    load(name, save(tmp_path / "full.safetensors", {**tensors, extra: torch.ones(2)}))
    prefix = "model." if name == "small-da3" else ""
    with pytest.raises(UserError, match=r"1 unexpected \(first: surprise\)"):
        load(name, save(tmp_path / "more.safetensors", {**tensors, f"{prefix}surprise": torch.ones(2)}))


def test_missing_and_misshapen_tensors_are_counted_and_named(tmp_path):
    tensors = load_file(VGGT / "weights.safetensors")
    del tensors["camera_head.trunk_norm.bias"]
    tensors["aggregator.camera_token"] = torch.ones(1, 2, 32)
    with pytest.raises(UserError) as error:
        load("small-vggt", save(tmp_path / "m.safetensors", tensors))
    parts = ("1 missing (first: camera_head.trunk_norm.bias)", "1 of another shape", "expected (1, 2, 1, 32)")
    assert one_sentence_about(error, *parts)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused(tmp_path, value):
    tensors = load_file(DA3 / "weights.safetensors")
    tensors[f"model.{FINAL_NORM}"][3] = value
    with pytest.raises(UserError, match="1 tensors hold values that are not finite") as error:
        load("small-da3", save(tmp_path / "m.safetensors", tensors))
    assert FINAL_NORM in str(error.value)


@pytest.mark.parametrize("kept", [0.97, 0.5, 0.001, 0.0])
@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_truncated_files_are_refused(tmp_path, suffix, kept):
    whole = save(tmp_path / f"whole{suffix}", load_file(VGGT / "weights.safetensors")).read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(UserError) as error:
        load("small-vggt", cut)
    assert one_sentence_about(error, str(cut))


class Surprise:
    """An object whose unpickling would run code."""

    def __reduce__(self):
        return Path.touch, (Path("unpickled"),)


def test_pickles_are_never_executed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"weight": torch.ones(2), "more": Surprise()}, "model.pt")
    with pytest.raises(UserError, match="never runs code") as error:
        load("small-vggt", tmp_path / "model.pt")
    assert one_sentence_about(error, "model.pt", "getattr", ".safetensors download")
    assert not Path("unpickled").exists()


def test_pickle_under_another_name_is_refused(tmp_path):
    torch.save({"weight": torch.ones(2)}, tmp_path / "model.safetensors")
    with pytest.raises(UserError, match="not a safetensors file"):
        load("small-vggt", tmp_path / "model.safetensors")


def test_something_else_in_a_pt_file_is_refused(tmp_path):
    torch.save([1, 2, 3], tmp_path / "list.pt")
    with pytest.raises(UserError, match="not a plain state dict"):
        load("small-vggt", tmp_path / "list.pt")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(UserError, match=r"unknown kind of checkpoint '\.txt'"):
        load("small-vggt", tmp_path / "notes.txt")


def test_folder_stands_for_its_weight_file(tmp_path):
    with pytest.raises(UserError, match="found 0 weight files"):
        find_file(tmp_path)
    (tmp_path / "vggt_1B_commercial.pt").touch()
    assert find_file(tmp_path).name == "vggt_1B_commercial.pt"
    (tmp_path / "one.safetensors").touch()
    assert find_file(tmp_path).name == "one.safetensors"
    (tmp_path / "two.safetensors").touch()
    with pytest.raises(UserError, match="found 2 weight files"):
        find_file(tmp_path)
    (tmp_path / "model.safetensors").touch()
    assert find_file(tmp_path).name == "model.safetensors"
    with pytest.raises(UserError, match="no such checkpoint"):
        find_file(tmp_path / "nowhere")


def test_a_family_of_models_is_added_by_naming_its_module(monkeypatch):
    family = ModuleType("family")
    family.ENTRIES = (ModelEntry(name="new", about="", licence="none", parameters=0, build=nn.Identity),)
    monkeypatch.setitem(sys.modules, "family", family)
    monkeypatch.setattr(catalog, "FAMILIES", (*catalog.FAMILIES, "family"))
    assert "new" in catalog.names()
    assert isinstance(catalog.build_empty("new"), nn.Identity)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("depth-anything/DA3-BASE", "da3-base"),
        ("depth-anything/da3-giant-1.1", "da3-giant"),
        ("https://huggingface.co/facebook/VGGT-1B", "vggt-1b"),
        ("DA3-Small", "da3-small"),
        ("depth-anything/DA3MONO-LARGE", "da3mono-large"),
    ],
)
def test_models_are_found_by_their_id_on_the_hub(name, found):
    assert catalog.entry(name).name == found


def test_a_model_that_is_given_by_another_name_has_its_own(tmp_path):
    embedded = catalog.load_model("FreeGeo-Tiny")
    assert embedded.loaded_from.model == embedded.spec.name == "freegeo-tiny"


def test_unknown_names_list_the_known_ones():
    with pytest.raises(UserError, match=r"unknown model 'vgt'.*da3-base.*vggt-1b, vggt-1b-commercial"):
        catalog.load_model("vgt")
    with pytest.raises(UserError, match="unknown model 'someone/DA3-BASE'"):
        catalog.load_model("someone/DA3-BASE")


@pytest.mark.parametrize(
    ("name", "not_built"),
    [
        ("da3-small", 0),
        ("da3-base", 0),
        ("da3-large", 0),
        ("da3-giant", GAUSSIAN_HEAD),
        ("da3nested-giant-large", GAUSSIAN_HEAD),
        ("da3mono-large", 0),
        ("da3metric-large", 0),
        ("vggt-1b", TRACKING_HEAD),
        ("vggt-1b-commercial", TRACKING_HEAD),
    ],
)
def test_variants_have_the_published_number_of_parameters(name, not_built):
    model = catalog.build_empty(name)
    assert sum(p.numel() for p in model.parameters()) == catalog.entry(name).parameters - not_built
    assert model.spec.weights_licence == catalog.entry(name).licence


def test_totals_are_the_published_ones():
    published = {
        "da3-small": 34_299_463,
        "da3-base": 135_366_599,
        "da3-large": 410_941_767,
        "da3-giant": 1_355_674_125,
        "da3nested-giant-large": 1_689_845_519,
        "da3mono-large": 334_171_394,
        "da3metric-large": 334_171_394,
        "vggt-1b": 1_256_537_516,
    }
    assert {name: catalog.entry(name).parameters for name in published} == published


@pytest.mark.parametrize(("name", "folder"), [("small-da3", DA3), ("small-vggt", VGGT)])
def test_saved_weights_have_the_official_names_and_load_again(tmp_path, name, folder):
    model, path = load(name, folder / "weights.safetensors"), tmp_path / "again.safetensors"
    save_weights(model, path, catalog.entry(name).keys, {"licence": "none"})
    assert load_file(path).keys() == load_file(folder / "weights.safetensors").keys()
    again = load(name, path).state_dict()
    assert all(torch.equal(value, again[key]) for key, value in model.state_dict().items())
