"""The adaptation loss against recorded values and gradients of the authors' release and of the paper's equations.

`cases(folder)` yields one check per recorded case and precision; a check returns its worst error divided by the
tolerance, so that it passes up to 1. The folder's README says what each file holds.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from fixture_tools import DEVICE
from freegeo.adaptation.losses import (
    StepDraws,
    TokenDraw,
    adaptation_loss,
)
from freegeo.adaptation.losses.sampling import anchor_positions
from freegeo.adaptation.recipe import PAPER, RELEASED_DA3, RELEASED_VGGT, LossConfig
from loss_tools import teacher_side

Levels = dict[int, tuple[Tensor, Tensor]]
WITHOUT_INTRA = {"weight_huber": 0.0, "weight_cosine": 0.0}
WITHOUT_ANGLES = {"angle_weights": (0.0, 0.0, 0.0)}
WITHOUT_DISTANCES = {"weight_pk": 0.0, "weight_pq": 0.0, "weight_kq": 0.0}
DTYPES = {"fp64": torch.float64, "fp32": torch.float32}


def cases(folder: Path) -> Iterator[tuple[str, Callable[[], float]]]:
    """Name and check of every recorded case in `folder`, in float64 and float32."""
    for path in sorted(folder.glob("*.safetensors")):
        if path.name.endswith(".inputs.safetensors"):
            continue
        check = _check_paper if path.name.startswith("paper_") else _check_released
        for name, dtype in DTYPES.items():
            yield f"{path.stem}.{name}", lambda path=path, check=check, dtype=dtype: check(path, dtype)


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    with safe_open(path, framework="pt", device=str(DEVICE)) as file:
        return {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118


def _value_error(value: Tensor, wanted: Tensor, same: bool = False) -> float:
    error = (value.double() - wanted.double()).abs()
    if same:
        return float(error / 1e-6)
    relative, absolute = (1e-10, 1e-12) if value.dtype == torch.float64 else (1e-5, 1e-6)
    return float(error / (relative * wanted.double().abs() + absolute))


def _gradient_error(gradient: Tensor, wanted: Tensor, tolerance: float, same: bool = False) -> float:
    error = (gradient.double() - wanted.double()).norm()
    return float(error / 1e-6) if same else float(error / wanted.double().norm() / tolerance)


def _worst(errors: list[float]) -> float:
    """The largest error; a NaN must not hide behind Python's `max`."""
    return float(torch.tensor(errors).nan_to_num(nan=torch.inf).max())


def _anchor_error(found: Tensor, wanted: Tensor) -> float:
    return 0.0 if torch.equal(found.sort(dim=-1).values, wanted.long().sort(dim=-1).values) else torch.inf


def _found_anchors(level: tuple[Tensor, Tensor], kept: list[int], draw: TokenDraw, config: LossConfig) -> Tensor:
    levels, held_out = teacher_side({0: level}, kept, config)
    return anchor_positions(levels[0], held_out, replace(draw, anchor=None), config)


def _split(features: Tensor, special_tokens: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    features = features.to(dtype)
    return features[:, :, special_tokens:].clone(), features[:, :, :special_tokens].clone()


def _loss_and_gradients(
    levels: Levels, teacher: Levels, kept: list[int], draws: StepDraws, config: LossConfig
) -> tuple[dict[str, Tensor], dict[int, Tensor]]:
    """Terms, and per layer the gradient of the total over [special tokens, patches] (B, M, T + P, C)."""
    inputs = {layer: tuple(part.clone().requires_grad_() for part in level) for layer, level in levels.items()}
    total, terms = adaptation_loss(inputs, *teacher_side(teacher, kept, config), draws, config)
    total.backward()
    zero = {
        layer: [torch.zeros_like(p) if p.grad is None else p.grad for p in parts] for layer, parts in inputs.items()
    }
    return terms, {layer: torch.cat([special, patch], dim=2) for layer, (patch, special) in zero.items()}


def _released_config(family: str, recorded: dict) -> LossConfig:
    config = (RELEASED_DA3 if family == "da3" else RELEASED_VGGT).loss
    w_pq, w_pk, w_kq = (recorded["weight_distance"] * weight for weight in recorded["distance_weights"])
    return replace(
        config,
        # The release's SmoothL1 with beta is the classical Huber penalty with delta = beta, divided by delta.
        weight_huber=recorded["weight_huber"] / recorded["huber_delta"],
        weight_cosine=recorded["weight_cos"],
        huber_delta=recorded["huber_delta"],
        angle_weights=tuple(recorded["weight_angle"] * weight for weight in recorded["angle_weights"]),
        weight_pk=w_pk,
        weight_pq=w_pq,
        weight_kq=w_kq,
        distance_mode=recorded["distance_mode"],
        distance_beta=recorded["distance_huber_beta"],
        temperature=recorded["temperature"],
        num_reference=recorded["num_ref"],
        num_query=recorded["num_shared"],
        num_anchors=recorded["num_anchors"],
        selection=recorded["selection"],
    )


def _recorded_draws(expected: dict[str, Tensor], tokens: int, other_views: int) -> StepDraws:
    found = {}
    for part in ("angle", "distance"):
        views = tokens * torch.arange(other_views, device=DEVICE)[:, None]
        found[part] = TokenDraw(
            reference=expected[f"index.{part}.ref"].long(),
            query=expected[f"index.{part}.shared"].long() + views,
            anchor=expected[f"index.{part}.anchor"].long(),
        )
    return StepDraws(**found)


def _check_released(path: Path, dtype: torch.dtype) -> float:
    expected, metadata = _read(path)
    inputs, about = _read(path.parent / f"{path.name.split('.')[0]}.inputs.safetensors")
    recorded, special = json.loads(metadata["config"]), int(about["special_tokens"])
    layers, kept = json.loads(about["layers"]), recorded["student_views"]
    same = path.name.startswith("da3_same")
    config = _released_config(metadata["family"], recorded)
    student = {layer: _split(inputs[f"student.{layer}"], special, dtype) for layer in layers}
    teacher = {layer: _split(inputs[f"teacher.{layer}"], special, dtype) for layer in layers}
    last = layers[-1]
    draws = _recorded_draws(expected, inputs[f"student.{last}"].shape[2], len(kept) - 1)

    errors = []
    if config.selection != "random":
        for name, draw in (("angle", draws.angle), ("distance", draws.distance)):
            found = _found_anchors(teacher[last], kept, draw, config)
            errors.append(_anchor_error(found, expected[f"index.{name}.anchor"]))

    def compare(found: Tensor, name: str) -> None:
        errors.append(_value_error(found, expected[f"value64.{name}"], same))

    run = (student, teacher, kept, draws)
    terms, _ = _loss_and_gradients(*run, config)
    every, _ = _loss_and_gradients(*run, replace(config, weight_kq=1.0))
    compare(terms["total"], "total")
    compare(terms["intra"], "intra")
    compare(terms["huber"] / config.huber_delta, "intra.huber")
    compare(1 - terms["cos"], "intra.cos")
    compare(terms["phi"] / recorded["weight_angle"], "angle")
    for found, name in (("phi1", "a1"), ("phi2", "a2"), ("phi3", "a3")):
        compare(terms[found], f"angle.{name}")
    for found, name in (("kl_pq", "d1"), ("kl_pk", "d2"), ("kl_kq", "d3")):
        compare(every[found], f"distance.{name}")

    coarse = 2e-6 if dtype == torch.float64 else 1e-5
    angle_tolerance = coarse if dtype == torch.float64 or config.angle_penalty == "huber" else 1e-4
    _, intra = _loss_and_gradients(*run, replace(config, **WITHOUT_ANGLES, **WITHOUT_DISTANCES))
    _, angle = _loss_and_gradients(*run, replace(config, **WITHOUT_INTRA, **WITHOUT_DISTANCES))
    _, distance = _loss_and_gradients(*run, replace(config, **WITHOUT_INTRA, **WITHOUT_ANGLES))
    for layer in layers:
        if f"grad.intra.{layer}" in expected:
            errors.append(_gradient_error(intra[layer], expected[f"grad.intra.{layer}"], coarse, same))
    wanted = expected[f"grad.angle.{last}"] * recorded["weight_angle"]
    errors.append(_gradient_error(angle[last], wanted, angle_tolerance, same))
    wanted = expected[f"grad.distance.{last}"] * recorded["weight_distance"]
    errors.append(_gradient_error(distance[last], wanted, coarse, same))
    return _worst(errors)


def _check_paper(path: Path, dtype: torch.dtype) -> float:
    expected, metadata = _read(path)
    recorded = json.loads(metadata["config"])
    special, kept, patches = recorded["special_tokens"], recorded["student_views"], recorded["num_patches"]
    student, teacher = ({0: _split(expected[name], special, dtype)} for name in ("student", "teacher"))
    other = [view for view in range(len(kept)) if view != recorded["ref_view"]]
    row = torch.tensor([other.index(int(view)) for view in expected["index.q_view"]], device=DEVICE)
    draw = TokenDraw(
        reference=expected["index.ref_token"].long(),
        query=(row * patches + expected["index.q_token"].long())[None],
        anchor=expected["index.anchor"].long(),
    )
    run = (student, teacher, kept, StepDraws(angle=draw, distance=draw))
    errors = []
    for temperature in recorded["temperatures"]:
        config = replace(
            PAPER.loss,
            temperature=temperature,
            huber_delta=recorded["huber_delta"],
            num_anchors=recorded["num_anchors"],
            num_reference=recorded["num_ref"],
            num_query=recorded["num_query"],
            reference_view=recorded["ref_view"],
        )
        found = _found_anchors(teacher[0], kept, draw, config)
        errors.append(_anchor_error(found, expected["index.anchor"]))
        errors += _paper_errors(expected, f"tau{temperature:g}", run, config, dtype)
    return _worst(errors)


def _paper_errors(
    expected: dict[str, Tensor],
    prefix: str,
    run: tuple[Levels, Levels, list[int], StepDraws],
    config: LossConfig,
    dtype: torch.dtype,
) -> list[float]:
    nothing = {**WITHOUT_INTRA, **WITHOUT_ANGLES, **WITHOUT_DISTANCES}
    only = {
        "total": config,
        "intra": replace(config, **WITHOUT_ANGLES, **WITHOUT_DISTANCES),
        "phi": replace(config, **WITHOUT_INTRA, **WITHOUT_DISTANCES),
        **{name: replace(config, **{**nothing, f"weight_{name[3:]}": 1.0}) for name in ("kl_pk", "kl_pq", "kl_kq")},
    }
    errors = []
    for name, variant in only.items():
        terms, gradients = _loss_and_gradients(*run, variant)
        if name == "total":
            recorded = [key for key in expected if key.startswith(f"{prefix}.value.")]
            errors += [_value_error(terms[key.split(".")[-1]], expected[key]) for key in recorded]
        if f"{prefix}.grad.{name}" in expected:
            tolerance = 2e-6 if dtype == torch.float64 else 1e-4 if name in ("phi", "total") else 1e-5
            errors.append(_gradient_error(gradients[0], expected[f"{prefix}.grad.{name}"], tolerance))
    return errors
