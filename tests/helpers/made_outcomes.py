"""Outcomes drawn at random, as an evaluation gives them: wrong branches, missed parts and false detections included."""

from __future__ import annotations

import numpy as np

from perception.outcomes import COMPARISONS, ERRORS, Outcome

POSES = {"inserted": 4, "main": 4, "top": 3}


def made_outcomes(
    method: str, n: int, seed: int, *, scale: float = 1.0, wrong: float = 0.04, missed: float = 0.02
) -> list[Outcome]:
    """``n`` parts, six an image, and one false detection in every fourth image. Scores tell right from wrong."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        name = str(rng.choice(list(POSES)))
        pose = int(rng.integers(POSES[name]))
        about = {
            "method": method,
            "domain": "classic",
            "image": k // 6,
            "instance": k % 6,
            "part": name,
            "stable_pose": pose,
            "visible_share": float(min(1.0, rng.uniform(0.5, 3.0))),
            "x_board_mm": float(rng.uniform(-105, 105)),
            "y_board_mm": float(rng.uniform(-66, 66)),
            "brightness": float(rng.uniform(20, 230)),
        }
        about["whole"] = about["visible_share"] >= 0.6
        if rng.uniform() < missed:
            out.append(Outcome(**about))
            continue
        bad = rng.uniform() < wrong
        kind = int(rng.integers(3)) if bad else -1
        e = np.abs(rng.normal(0, [0.02, 0.02, 0.01, 0.1])) * scale + (np.array([0.3, 0.3, 0.5, 90]) if bad else 0)
        if kind == 2:
            e[3] = 180.0
        errors: dict[str, float] = dict(zip(ERRORS, e.tolist(), strict=True))
        raw = {name: 30 * value for name, value in errors.items()}
        score = float(rng.beta(3, 3) if bad else rng.beta(30, 1))
        estimated = (name, pose)
        if kind == 0:
            estimated = (str(rng.choice([p for p in POSES if p != name])), 0)
        elif kind == 1:
            estimated = (name, (pose + 1) % POSES[name])
        out.append(
            Outcome(
                **about,
                detected=True,
                iou=float(rng.uniform(0.9, 0.98)),
                score=score,
                accepted=score > 0.7,
                verdict="accepted" if score > 0.7 else "ambiguous",
                estimated_part=estimated[0],
                estimated_stable_pose=estimated[1],
                class_right=kind != 0,
                face_right=kind not in (0, 1),
                branch_right=not bad,
                branch_right_equivalent=not bad,
                yaw_error_deg=None if kind in (0, 1) else float(e[3]),
                errors=dict.fromkeys(COMPARISONS, errors),
                raw_errors=dict.fromkeys(COMPARISONS, raw),
                mssd_mm=None if kind == 0 else float(np.linalg.norm(e[:3]) + np.radians(e[3]) * 4),
                nees=None if bad or method != "tagcell" else float(rng.chisquare(6)),
                nees_planar=None if bad or method != "tagcell" else float(rng.chisquare(3) * 1.4),
            )
        )
    for image in range(0, n // 6, 4):
        score = float(rng.beta(2, 4))
        out.append(
            Outcome(
                method=method,
                domain="classic",
                image=image,
                instance=-1,
                detected=True,
                score=score,
                accepted=score > 0.7,
                verdict="accepted" if score > 0.7 else "ambiguous",
                estimated_part="top",
                estimated_stable_pose=1,
            )
        )
    return out
