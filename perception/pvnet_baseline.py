"""The published method as an estimator: what this project's own is compared with.

Detections and classes are those of our own segmentation, the same for all methods; a detection's class is the likeliest
one, as Mask R-CNN gives it in the paper this project starts from. The class's PVNet places keypoints, EPnP gives the
raw pose, and stable pose and table refine it. Nothing checks the result: every pose is accepted.
"""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from cad.parts import Part, load_part, planar
from cad.spatial import Array, Intrinsics
from cad.tagboard import TagboardConfig
from perception.calibration import camera_from_tags, table_from_board
from perception.crop_poses import HALF
from perception.estimates import ACCEPTED, Frame, FrameEstimate, PartEstimate, PerceptionError, halved
from perception.estimator import WEIGHTS, cut_crops
from perception.labels import ray_of_crop
from perception.planar import PlanarError, on_plane
from perception.pnp import PnpError
from perception.posenets import CropKeypoints
from perception.pvnet_baseline_net import Pvnets, vote_keypoints
from perception.pvnet_baseline_pose import BaselinePose, pose_from_keypoints
from perception.segmentation import Detection, Segmenter
from perception.standard_view import frame_scale
from perception.weight_files import load_weights

PVNET_WEIGHTS = "pvnet.safetensors"
NO_POSE = "no pose from keypoints"
"""Verdict of a detection whose keypoints give no pose. It still carries one, so that it counts as wrong and not as
missing: the likeliest stable pose below the detection's centre, unturned."""


class PvnetEstimator:
    """See the module's text; implements ``PoseEstimator``. An estimate's ``raw_T_cam_part`` is PVNet's pose, its
    ``T_cam_part`` the refined one, its mask that of the detection; it states no covariance.
    """

    def __init__(
        self,
        weights_dir: Path | None = None,
        tagboard: TagboardConfig | None = None,
        parts_dir: Path | None = None,
        seed: int = 0,
    ) -> None:
        """Load the weights in ``weights_dir`` (those of the package by default); ``seed`` is that of the votes' pairs.

        Raises PerceptionError when weights are missing, do not fit the parts, or know other parts than the
        segmentation.
        """
        folder = weights_dir or WEIGHTS
        self.tagboard = tagboard or TagboardConfig()
        self.segmenter = Segmenter.load(folder, parts_dir)
        self.nets, self.parts = load_pvnets(folder / PVNET_WEIGHTS, parts_dir)
        self.seed = seed
        unknown = [name for name in self.segmenter.part_names if name not in self.parts]
        if unknown:
            raise PerceptionError(
                f"{folder / PVNET_WEIGHTS} knows {', '.join(self.parts)} but not {', '.join(unknown)}, which the "
                "segmentation finds; train it on the same parts with `python -m perception.train pvnet`"
            )

    def estimate(self, frame: Frame) -> FrameEstimate:
        """One estimate for each detection, best first.

        Raises PerceptionError when the frame shows too few tags or is smaller than a crop.
        """
        clock = _Clock()
        tags = camera_from_tags(frame, self.tagboard)
        T_cam_table = table_from_board(tags.T_cam_board)
        clock.lap("tags")
        scale = frame_scale(frame.intrinsics, T_cam_table)
        detections = self.segmenter.detect(frame, scale)
        clock.lap("segmentation")
        crops, full = cut_crops(frame, detections, scale)
        intrinsics = [camera.downscaled(HALF) for camera in full]
        names = [self.segmenter.part_names[int(d.class_probabilities.argmax())] for d in detections]
        voted = self._votes(crops, intrinsics, names)
        clock.lap("networks")
        found = [
            self._estimate(frame, detection, self.parts[name], keypoints, camera, T_cam_table)
            for detection, name, keypoints, camera in zip(detections, names, voted, intrinsics, strict=True)
        ]
        clock.lap("poses")
        return FrameEstimate(
            T_cam_board=tags.T_cam_board,
            parts=tuple(found),
            tags_seen=tags.tags_seen,
            tag_rms_px=tags.rms_px,
            seconds=clock.seconds,
        )

    def _votes(self, crops: NDArray[np.uint8], intrinsics: list[Intrinsics], names: list[str]) -> list[CropKeypoints]:
        """Keypoints of each crop (N, 256, 256, 3) from the network of its class."""
        rng = np.random.default_rng(self.seed)
        halves = np.stack([halved(crop) for crop in crops]) if len(crops) else crops
        rays = np.array([ray_of_crop(camera) for camera in intrinsics]).reshape(-1, 2)
        of_row: dict[int, CropKeypoints] = {}
        for name in self.parts:
            rows = np.flatnonzero([n == name for n in names])
            of_row |= zip(rows.tolist(), vote_keypoints(self.nets, name, halves[rows], rays[rows], rng), strict=True)
        return [of_row[i] for i in range(len(crops))]

    def _estimate(
        self,
        frame: Frame,
        detection: Detection,
        part: Part,
        keypoints: CropKeypoints,
        intrinsics: Intrinsics,
        T_cam_table: Array,
    ) -> PartEstimate:
        details = {
            "class_probability": float(detection.class_probabilities.max()),
            "keypoint_sigma_px": float(np.sqrt(np.trace(keypoints.covariances, axis1=1, axis2=2) / 2).mean()),
        }
        verdict = ACCEPTED
        try:
            pose = pose_from_keypoints(part, keypoints, intrinsics, T_cam_table)
            details |= {"rms_px": pose.rms_px, "lean_deg": float(np.degrees(pose.lean))}
        except (PnpError, PlanarError):
            verdict, pose = NO_POSE, likeliest_rest(part, detection.centre_px, frame.intrinsics, T_cam_table)
        mask, origin = frame_mask(detection)
        return PartEstimate(
            part=part.name,
            T_cam_part=pose.T_cam_part,
            stable_pose=pose.stable_pose,
            score=detection.score,
            verdict=verdict,
            raw_T_cam_part=pose.raw_T_cam_part,
            mask=mask,
            mask_origin=origin,
            details=details,
        )


def load_pvnets(path: Path, parts_dir: Path | None = None) -> tuple[Pvnets, dict[str, Part]]:
    """The networks kept in a weight file, ready to use, and their parts by name.

    Raises PerceptionError when there is none, or it was trained for other meshes or another network.
    """
    state, metadata = load_weights(path, parts_dir)
    parts = {name: load_part(name, parts_dir) for name in metadata["parts"]}
    nets = Pvnets({name: len(part.keypoints) for name, part in parts.items()})
    try:
        nets.load_state_dict(state)
    except RuntimeError as error:
        raise PerceptionError(f"{path} holds another network than this version's; train again") from error
    return nets.to(memory_format=torch.channels_last).eval(), parts  # pyright: ignore[reportCallIssue]


def likeliest_rest(part: Part, centre_px: Array, intrinsics: Intrinsics, T_cam_table: Array) -> BaselinePose:
    """The part's likeliest stable pose below a pixel of the frame, unturned: what stands where no pose was found."""
    pose = max(part.stable_poses, key=lambda p: p.probability)
    x, y, _ = on_plane(centre_px, 0.0, intrinsics, T_cam_table)
    T_cam_part = T_cam_table @ planar(float(x), float(y), 0.0) @ pose.T_table_part
    return BaselinePose(
        raw_T_cam_part=T_cam_part, T_cam_part=T_cam_part, stable_pose=pose.index, lean=np.nan, rms_px=np.nan
    )


def frame_mask(detection: Detection) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """A detection's mask (h, w) in pixels of the frame and its first pixel (u, v) there."""
    low = np.array(detection.mask_origin)
    high = low + detection.mask.shape[::-1]
    first, last = (np.round(corner * np.array(detection.reduction)).astype(int) for corner in (low, high))
    width, height = (int(n) for n in np.maximum(last - first, 1))
    mask = cv2.resize(detection.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(mask, dtype=bool), (int(first[0]), int(first[1]))


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage], self.last = now - self.last, now
