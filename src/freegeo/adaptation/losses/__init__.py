"""The losses of the method: intra, angles and distances, in the paper's and in both released versions.

Reading order: `config` (the versions), `sampling` (which tokens), `targets` (what is kept of the teacher), `assemble`
(the whole loss), then the three terms `intra`, `relational`, `divergence`.
"""

from freegeo.adaptation.losses.assemble import adaptation_loss, feature_distance, require_finite, teacher_spread
from freegeo.adaptation.losses.config import LossConfig, paper_loss, released_da3_loss, released_vggt_loss
from freegeo.adaptation.losses.divergence import Precision, choose_precision
from freegeo.adaptation.losses.sampling import StepDraws, TokenDraw, draw_tokens
from freegeo.adaptation.losses.targets import AnchorFeatures, TeacherTargets, held_out_tokens, teacher_targets

__all__ = [
    "AnchorFeatures",
    "LossConfig",
    "Precision",
    "StepDraws",
    "TeacherTargets",
    "TokenDraw",
    "adaptation_loss",
    "choose_precision",
    "draw_tokens",
    "feature_distance",
    "held_out_tokens",
    "paper_loss",
    "released_da3_loss",
    "released_vggt_loss",
    "require_finite",
    "teacher_spread",
    "teacher_targets",
]
