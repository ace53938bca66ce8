"""The losses of the method: intra, angles and distances, in the paper's and in both released versions.

Reading order: `equations` (the paper, plainly), `sampling` (which tokens), `targets` (what is kept of the teacher),
`assemble` (the whole loss), then the fast forms of the three terms: `intra`, `angles`, `divergence`. The versions are
literals in `freegeo.adaptation.recipe`.
"""

from freegeo.adaptation.losses.assemble import adaptation_loss, feature_distance, require_finite, teacher_spread
from freegeo.adaptation.losses.divergence import KLForm, choose_form
from freegeo.adaptation.losses.sampling import StepDraws, TokenDraw, draw_tokens
from freegeo.adaptation.losses.targets import AnchorFeatures, Level, TeacherTargets, held_out_tokens, teacher_targets
from freegeo.adaptation.recipe import LossConfig

__all__ = [
    "AnchorFeatures",
    "KLForm",
    "Level",
    "LossConfig",
    "StepDraws",
    "TeacherTargets",
    "TokenDraw",
    "adaptation_loss",
    "choose_form",
    "draw_tokens",
    "feature_distance",
    "held_out_tokens",
    "require_finite",
    "teacher_spread",
    "teacher_targets",
]
