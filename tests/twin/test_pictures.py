import cv2
import numpy as np

from cad.parts import load_part
from cad.spatial import BASLER, rotation_x, transform
from perception.estimates import Frame, FrameEstimate, PartEstimate
from perception.overlay import INSET, save_picture
from twin.pictures import annotate

PARTS = {name: load_part(name) for name in ("main", "top")}


def test_an_annotated_frame_shows_every_part(tmp_path):
    frame = Frame(image=np.full((BASLER.height, BASLER.width, 3), 90, np.uint8), intrinsics=BASLER, time_s=0.0)
    mask = np.ones((60, 80), bool)
    parts = tuple(
        PartEstimate(
            part=name,
            T_cam_part=transform(rotation_x(np.pi), [x, 0.0, 0.7]),
            stable_pose=0,
            score=0.9,
            verdict=verdict,
            mask=mask,
            mask_origin=(int(BASLER.project([x, 0.0, 0.7])[0]) - 40, 1800),
        )
        for name, x, verdict in (("main", -0.05, "accepted"), ("top", 0.05, "ambiguous"))
    )
    estimate = FrameEstimate(T_cam_board=np.eye(4), parts=parts, tags_seen=20, tag_rms_px=0.05)
    grasp = transform(None, parts[0].T_cam_part[:3, 3])
    picture = annotate(frame, estimate, PARTS, grasp, 0.015)
    assert picture.shape[1] == BASLER.width // 4
    assert picture.shape[0] == BASLER.height // 4 + INSET + 4
    plain = annotate(frame, FrameEstimate(T_cam_board=np.eye(4), parts=(), tags_seen=20, tag_rms_px=0.05), PARTS)
    for part in parts:  # each part leaves a mark around its place in the overview
        u, v = (BASLER.project(part.T_cam_part[:3, 3]) / 4).astype(int)
        window = np.s_[v - 15 : v + 15, u - 15 : u + 15]
        assert (picture[window] != plain[window]).any()
    save_picture(tmp_path / "frames" / "a.jpg", picture)
    assert cv2.imread(str(tmp_path / "frames" / "a.jpg")).shape == picture.shape
    assert [p.name for p in (tmp_path / "frames").iterdir()] == ["a.jpg"]
