"""Models of a few thousand parameters with seeded random weights, adapters on them, and scenes of noise."""

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from freegeo.adaptation.adapter import Adapter
from freegeo.adaptation.recipe import Recipe, scene
from freegeo.adaptation.samples import SceneImages
from freegeo.geometry.camera import pixel_grid
from freegeo.models.api import ReconstructionModel
from freegeo.models.da3 import DA3
from freegeo.models.da3_config import DA3Config
from freegeo.models.da3_metric import DA3Nested, DA3SingleView
from freegeo.models.mapanything import MapAnything
from freegeo.models.mapanything_config import MapAnythingConfig
from freegeo.models.pi3 import Pi3
from freegeo.models.pi3_config import Pi3Config, Pi3XConfig
from freegeo.models.pi3_config import build as build_pi3
from freegeo.models.spec import NO_REFERENCE, AdaptationDefaults, ModelSpec
from freegeo.models.vggt import VGGT
from freegeo.models.vggt_config import VGGTConfig

PATCH = 8
DEFAULTS = AdaptationDefaults(temperature=1.0, scene_lr=3e-3, rank=4)
ANY_VIEW = DA3Config(
    width=32, depth=6, heads=2, out_layers=(2, 3, 4, 5), alt_start=2, qknorm_start=2, rope_start=2,
    head_features=8, head_channels=(4, 8, 8, 8), patch_size=PATCH, position_grid=4,
    camera_encoder_depth=1, camera_encoder_heads=2,
)  # fmt: skip
SINGLE_VIEW = replace(ANY_VIEW, alt_start=6, qknorm_start=6, rope_start=6, cat_token=False)


def tiny_da3(seed: int = 0, ffn: str = "mlp", name: str = "tiny-da3") -> DA3:
    """Two per-view blocks and four cross-view ones, width 32."""
    return randomise(
        DA3(replace(ANY_VIEW, ffn=ffn), _spec(name, ANY_VIEW.out_layers, special=1, takes="cameras")), seed
    )


def tiny_single_view(seed: int = 0, name: str = "tiny-single-view") -> DA3SingleView:
    """Six per-view blocks, width 32."""
    return randomise(DA3SingleView(SINGLE_VIEW, _spec(name, SINGLE_VIEW.out_layers, special=1, cameras=False)), seed)


def tiny_nested(seed: int = 0, name: str = "tiny-nested") -> DA3Nested:
    """The tiny any-view model beside the tiny single-view one."""
    spec = _spec(name, ANY_VIEW.out_layers, special=1, metric=True, ray_cameras=True, takes="cameras")
    return randomise(DA3Nested(ANY_VIEW, SINGLE_VIEW, spec), seed)


def tiny_vggt(seed: int = 0, name: str = "tiny-vggt") -> VGGT:
    """Two encoder blocks and four pairs of frame and global blocks, width 32."""
    config = VGGTConfig(
        width=32, depth=4, heads=2, encoder_depth=2, encoder_heads=2, camera_depth=1, camera_heads=2,
        out_layers=(0, 1, 2, 3), head_features=8, head_channels=(4, 8, 8, 8), registers=2, patch_size=PATCH,
        position_grid=4,
    )  # fmt: skip
    return randomise(VGGT(config, _spec(name, config.out_layers, special=config.special)), seed)


PI3 = Pi3Config(
    width=32, pairs=2, heads=2, encoder_depth=2, encoder_heads=2, head_width=24, head_depth=2, head_heads=3,
    dense_out=16, camera_out=16, registers=3, encoder_registers=2, patch_size=PATCH, position_grid=4,
    pixels=48 * 64,
)  # fmt: skip
PI3X = replace(
    PI3,
    x=Pi3XConfig(
        head_channels=(16, 16, 16), head_units=1, head_hidden=8, scale_width=16, scale_depth=1, scale_heads=2,
        scale_out=12, pose_pairs=(0,),
    ),
)  # fmt: skip


def tiny_pi3(seed: int = 0, name: str = "tiny-pi3") -> Pi3:
    """Two encoder blocks and two pairs of blocks within and across views, width 32; all views alike."""
    return randomise(build_pi3(PI3, _spec(name, (PI3.readout,), special=PI3.registers, reference=NO_REFERENCE)), seed)


def tiny_pi3x(seed: int = 0, name: str = "tiny-pi3x") -> Pi3:
    """The same with metres, and known poses, intrinsics and depth."""
    spec = _spec(name, (PI3X.readout,), special=PI3X.registers, reference=NO_REFERENCE, takes="parts", metric=True)
    return randomise(build_pi3(PI3X, spec), seed)


def tiny_mapanything(seed: int = 0, name: str = "tiny-mapanything") -> MapAnything:
    """Two encoder blocks and six blocks across views, width 32; its rays are roughly those of a camera."""
    config = MapAnythingConfig(
        width=32, heads=2, encoder_depth=2, depth=6, out_layers=(1, 3, 5), dense_encoder=(8, 8, 8),
        global_encoder=(8, 8, 8), head_features=16, head_channels=(4, 8, 8, 8), pose_hidden=16, scale_hidden=8,
        patch_size=PATCH, position_grid=4,
    )  # fmt: skip
    spec = _spec(name, config.out_layers, special=1, metric=True, takes="parts")
    model = randomise(MapAnything(config, spec), seed)
    if model.scale_token.is_meta:
        return model
    with torch.no_grad():
        model.encoder["model"].pos_embed *= 20
    features = model.aggregate(model.embed(torch.stack([noise(2, scene) for scene in range(8)])))
    last = model.dense_head[1].conv2[2]
    seen: list[Tensor] = []
    hook = last.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    levels = [level.flatten(0, 1) for level in model.dense_levels(features)]
    image_hw = model.dense(levels, features.grid_hw).shape[-2:]
    hook.remove()
    hidden = F.pad(seen[0].movedim(1, -1), (0, 1), value=1.0).flatten(0, 2)
    wanted = (pixel_grid(image_hw, like=hidden)[..., :2] / image_hw[0] - 0.5).expand(16, *image_hw, 2).flatten(0, 2)
    with torch.no_grad():
        weights = torch.linalg.lstsq(hidden, wanted).solution
        last.weight[:3], last.bias[:3] = 0, torch.tensor([*weights[-1], 1.0])
        last.weight[:2, :, 0, 0] = weights[:-1].T
        last.bias[5] = 3.0
    return model


def randomise(model: nn.Module, seed: int) -> nn.Module:
    """Draw every weight so that signals keep their size, and freeze the model as loading does."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            drawn = torch.randn(parameter.shape, generator=generator)
            if parameter.ndim > 1:
                parameter.copy_(drawn * parameter[0].numel() ** -0.5)
            elif name.endswith("bias"):
                parameter.copy_(drawn * 0.1)
            parameter.requires_grad_(False)
    return model.eval()


def noise(views: int, seed: int = 0, side: int = 4 * PATCH) -> Tensor:
    """Return images (S, 3, side, side): one smooth random scene, seen with noise."""
    generator = torch.Generator().manual_seed(seed)
    shared = torch.rand(1, 3, side, side, generator=generator)
    return (shared + 0.3 * torch.randn(views, 3, side, side, generator=generator)).clamp(0, 1)


def noise_scene(views: int, seed: int = 0) -> SceneImages:
    """Return a scene of noise."""
    images = noise(views, seed)
    return SceneImages(name=f"noise-{seed}", count=views, load=lambda frames: images[list(frames)])


def quick(model: ReconstructionModel, **changes) -> Recipe:
    """Return the recipe `scene`, small enough for a test, and without `hold`."""
    length = {} if "epochs" in changes else {"steps": 4}
    return scene(model.spec).changed(**{**length, "sets_per_scene": 3, "distinct_seeds": 3, "hold": 0.0, **changes})


def outputs(model: ReconstructionModel, images: Tensor) -> list[Tensor]:
    """Return depth, confidence and cameras of images (S, 3, H, W)."""
    with torch.no_grad():
        found = model.decode(model.aggregate(model.embed(images[None])))
    return [found.depth_z, found.conf, found.T_cam_world, found.K]


def same(one: list[Tensor], two: list[Tensor]) -> bool:
    """Say whether two lists of tensors agree in every bit."""
    return all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def attach(model: ReconstructionModel, rank: int = 4, seed: int = 0, dropout: float = 0.0, **options) -> Adapter:
    """Put a fresh adapter on a model."""
    generator = torch.Generator().manual_seed(seed)
    return Adapter.attach(model, rank=rank, alpha=rank, dropout=dropout, generator=generator, **options)


def trained(model: ReconstructionModel, seed: int = 1) -> Adapter:
    """Put an adapter on a model, with random values in the place of trained ones."""
    adapter = attach(model)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in adapter.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.1)
    return adapter


def _spec(name: str, layers: tuple[int, ...], special: int, reference: str = "first", **more) -> ModelSpec:
    return ModelSpec(
        name=name, patch_size=PATCH, default_side=4 * PATCH, loss_layers=layers, reference=reference,
        special_tokens=special, weights_licence="none", adaptation=DEFAULTS, **more,
    )  # fmt: skip


def parts_of(value) -> list[Tensor]:
    """Return the tensors of tokens, features or a sample, in a fixed order."""
    found: list[Tensor] = []
    value.map(lambda tensor: found.append(tensor) or tensor)
    return found


def tensors(result) -> list[torch.Tensor]:
    """The tensors of a finished run's adapter."""
    return [parameter.detach() for parameter in result.adapter.parameters()]
