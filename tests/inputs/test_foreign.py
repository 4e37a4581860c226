"""Cameras of Metashape, RealityScan, Bundler and VisualSFM: poses, lenses, names, and files that do not fit."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.inputs.test_given_cameras import NAMES
from tests.reconstruction.conftest import SIZE
from vg2gt.cli import reconstruct as reconstruct_command
from vg2gt.inputs.camera_files import read_cameras
from vg2gt.inputs.cameras import pictures_for
from vg2gt.inputs.foreign import matched
from vg2gt.inputs.given_cameras import given_pictures
from vg2gt.io.photogrammetry import ForeignCamera, read_photogrammetry

OPENGL = np.diag([1.0, -1, -1, 1])
LOCAL = np.eye(4)  # of a Metashape component: turned, moved and three times as large as its world
LOCAL[:3, :3] = Rotation.from_euler("xyz", [30, -50, 10], degrees=True).as_matrix() / 3
LOCAL[:3, 3] = 4, -7, 2


def text_of(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def metashape(folder: Path, poses: np.ndarray, focal: float, center: np.ndarray) -> Path:
    cameras = []
    for number, (name, pose) in enumerate(zip(NAMES, poses, strict=True)):
        local = np.linalg.inv(LOCAL) @ np.linalg.inv(pose)
        local[:3, :3] /= 3  # rigid in the component
        label = name if number % 2 else Path(name).stem
        cameras.append(f'<camera id="{number}" sensor_id="0" component_id="0" label="{label}">'
                       f"<transform>{text_of(local)}</transform></camera>")  # fmt: skip
    offset = center + 0.5 - np.array(SIZE[::-1]) / 2
    path = folder / "cameras.xml"
    path.write_text(f"""<?xml version="1.0"?>
<document version="1.5.0"><chunk label="Chunk 1"><sensors><sensor id="0" type="frame">
<resolution width="{SIZE[1]}" height="{SIZE[0]}"/><calibration type="frame" class="adjusted">
<f>{focal}</f><cx>{offset[0]}</cx><cy>{offset[1]}</cy></calibration></sensor></sensors>
<components><component id="0"><transform><rotation>{text_of(LOCAL[:3, :3] * 3)}</rotation>
<translation>{text_of(LOCAL[:3, 3])}</translation><scale>{1 / 3}</scale></transform></component></components>
<cameras>{"".join(cameras[:2])}<group id="0" label="more">{"".join(cameras[2:])}</group>
<camera id="9" sensor_id="0" label="not aligned"/></cameras></chunk></document>""")
    return path


def reality_scan(folder: Path, poses: np.ndarray, focal: float, center: np.ndarray) -> Path:
    rows = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    unit = SIZE[1] / 36
    offset = (center + 0.5 - np.array(SIZE[::-1]) / 2) / unit
    for name, pose in zip(NAMES, poses, strict=True):
        world = np.linalg.inv(OPENGL @ pose)
        yaw, pitch, roll = Rotation.from_matrix(world[:3, :3]).as_euler("ZXY", degrees=True)
        numbers = [*world[:3, 3], -yaw, pitch, roll, focal / unit, *offset, 0, 0, 0, 0, 0, 0]
        rows.append(",".join([name, *(repr(float(number)) for number in numbers)]))
    path = folder / "cameras.csv"
    path.write_text("\ufeff" + "\n".join(rows) + "\n")
    return path


def bundler(folder: Path, poses: np.ndarray, focal: float, center: np.ndarray) -> Path:
    rows = [f"# Bundle file v0.3\n{len(poses) + 1} 0"]
    for pose in poses:
        world = OPENGL @ pose
        rows += [f"{focal} 0 0", *(text_of(row) for row in world[:3, :3]), text_of(world[:3, 3])]
    rows += ["0 0 0"] * 5  # not placed
    (folder / "bundle").mkdir()
    (folder / "bundle" / "bundle.out").write_text("\n".join(rows))
    (folder / "list.txt").write_text("".join(f"images/{name} 0 {focal}\n" for name in [*NAMES, "lost.png"]))
    return folder / "bundle" / "bundle.out"


def nvm(folder: Path, poses: np.ndarray, focal: float, center: np.ndarray) -> Path:
    rows = ["NVM_V3", "", str(len(poses))]
    for name, pose in zip(NAMES, poses, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        rows.append(f"images/{name}\t{focal} {text_of(quaternion)} {text_of(-pose[:3, :3].T @ pose[:3, 3])} 0 0")
    path = folder / "model.nvm"
    path.write_text("\n".join([*rows, "0", ""]))
    return path


WRITERS = {"metashape": metashape, "reality_scan": reality_scan, "bundler": bundler, "nvm": nvm}


@pytest.fixture(params=WRITERS)
def case(request, folder: Path, frames) -> tuple[Path, np.ndarray, np.ndarray]:
    """A file of cameras next to images, the true poses and the true intrinsics."""
    pytest.importorskip("pycolmap")
    poses = frames.world_to_camera.double().numpy()
    left, _, right = np.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = left @ right
    matrix = frames.intrinsics[0].double().numpy().copy()
    matrix[1, 1] = matrix[0, 0]
    if request.param in ("bundler", "nvm"):  # in the image's centre
        matrix[:2, 2] = (np.array(SIZE[::-1]) - 1) / 2
    return WRITERS[request.param](folder, poses, matrix[0, 0], matrix[:2, 2]), poses, matrix


def test_poses_and_intrinsics_are_kept(case) -> None:
    """In the world of the file, from the folder, from the images' folder, and from the file itself."""
    path, poses, matrix = case
    root = path.parent.parent if path.parent.name == "bundle" else path.parent
    for given in (root, root / "images", path):
        pictures = given_pictures(given) or []
        assert [f"{picture.name}.png" for picture in pictures] == NAMES
        assert {picture.source for picture in pictures} == {f"{path.name} {path.parent}"}
        for picture, pose in zip(pictures, poses, strict=True):
            np.testing.assert_allclose(picture.pose, pose, atol=1e-6)
            np.testing.assert_allclose(picture.intrinsics, matrix, atol=1e-4)
            np.testing.assert_allclose(picture.read(SIZE).intrinsics[0], matrix, atol=1e-3)
    if path.parent == root:
        rendered = read_cameras(path)
        np.testing.assert_allclose([camera.world_to_camera for camera in rendered], poses, atol=1e-6)
        assert [(camera.height, camera.width) for camera in rendered] == [SIZE] * 4


def distorted(camera: ForeignCamera, x: float, y: float) -> np.ndarray:
    """Pixels of a ray (x, y, 1), as the program's manual has it; OpenCV's order of p1 and p2."""
    radius = np.hypot(x, y)
    if camera.kind == "fisheye":
        angle = np.arctan(radius)
        x, y, radius = x * angle / radius, y * angle / radius, angle
    factor = 1 + sum(k * radius ** (2 * power) for power, k in enumerate(camera.radial, 1))
    p1, p2 = camera.tangential
    across = x * factor + p2 * (radius**2 + 2 * x * x) + 2 * p1 * x * y
    down = y * factor + p1 * (radius**2 + 2 * y * y) + 2 * p2 * x * y
    return np.array([across, down]) * camera.focal + np.array(camera.size[::-1]) / 2 + camera.principal


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
@pytest.mark.parametrize("radial", [(-0.2, 0.07, -0.02, 0.0), (-0.15, 0.05, -0.02, 0.01)])
def test_lenses_of_metashape(tmp_path: Path, kind: str, radial, caplog) -> None:
    """``p1`` and ``p2`` have the other order than OpenCV's, ``b1`` is the difference of the focal lengths."""
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "cameras.xml"
    terms = "".join(f"<k{n}>{k}</k{n}>" for n, k in enumerate(radial, 1))
    path.write_text(
        f'<document><chunk><sensors><sensor id="3" type="{kind}"><resolution width="4000" height="3000"/>'
        f'<calibration class="adjusted" type="{kind}"><f>3000</f><cx>12</cx><cy>-7</cy><b1>4</b1>{terms}<p1>0.002</p1>'
        '<p2>-0.001</p2></calibration></sensor></sensors><cameras><camera sensor_id="3" label="a"><transform>'
        f"{text_of(np.eye(4))}</transform></camera></cameras></chunk></document>"
    )
    (camera,) = read_photogrammetry(path)
    assert not caplog.records
    assert camera.tangential == (-0.001, 0.002)
    assert camera.focal == (3004, 3000)
    model, params = camera.lens((3000, 4000))
    lens = pycolmap.Camera(model=model, width=4000, height=3000, params=params)
    for x, y in ((0.1, 0.2), (-0.6, 0.4), (0.5, -0.45), (0.01, -0.3)):
        np.testing.assert_allclose(lens.img_from_cam(np.array([[x, y, 1.0]]))[0], distorted(camera, x, y), atol=0.05)
    path.write_text(path.read_text().replace("<p1>", "<p3>0.1</p3><b2>0.5</b2><p1>"))
    read_photogrammetry(path)
    assert "of a, p3 (tangential distortion) is ignored" in caplog.text


def test_the_lens_of_visualsfm_undistorts_what_is_measured() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    camera = ForeignCamera("a", np.eye(4), None, (900.0, 900.0), radial=(0.12, 0, 0, 0), kind="measured")
    model, params = camera.lens((800, 1200))
    lens = pycolmap.Camera(model=model, width=1200, height=800, params=params)
    for measured in (np.array([0.3, 0.2]), np.array([-0.6, 0.35])):
        ideal = measured * (1 + 0.12 * (measured @ measured))
        found = lens.img_from_cam(np.array([[*ideal, 1.0]]))[0]
        np.testing.assert_allclose(found, measured * 900 + [600, 400], atol=0.05)


@pytest.mark.parametrize("kind", ["components", "chunks"])
def test_worlds_of_metashape_are_not_mixed(folder: Path, frames, kind: str, caplog) -> None:
    """Components without a transform, and chunks, have worlds of their own, which were taken for one."""
    path = metashape(folder, frames.world_to_camera.double().numpy(), 90.0, np.array([55.5, 41.5]))
    content = path.read_text()
    if kind == "components":
        content = content.replace("</component></components>", '</component><component id="1"/></components>')
        content = content.replace('id="3" sensor_id="0" component_id="0"', 'id="3" sensor_id="0" component_id="1"')
    else:
        first, second = content.index('<camera id="3"'), content.index("</group>")
        moved = f"<cameras>{content[first:second]}</cameras></chunk></document>"
        sensors = content[content.index("<sensors>") : content.index("<cameras>")]
        content = (content[:first] + content[second:]).replace("</document>", f"<chunk>{sensors}{moved}")
    path.write_text(content)
    assert [Path(camera.name).stem for camera in read_photogrammetry(path)] == ["008", "009", "010"]
    assert f"{path} has several chunks or components" in caplog.text
    assert "ignored: 011" in caplog.text


def test_names_are_matched_by_folders_names_and_stems() -> None:
    cameras = [
        ForeignCamera(name, np.eye(4), None, (1.0, 1.0)) for name in ("C:\\p\\front\\1.JPG", "back/1.jpg", "2", "3.tif")
    ]
    files = [Path(f"/x/{name}") for name in ("front/1.jpg", "back/1.jpg", "2.jpg", "3.jpg", "4.jpg")]
    found = matched(cameras, files)
    assert [found[file].name for file in files[:4]] == ["C:\\p\\front\\1.JPG", "back/1.jpg", "2", "3.tif"]
    assert len(found) == 4
    assert matched(cameras[:1], [Path("/x/a/1.jpg"), Path("/x/b/1.jpg")]) == {}  # either could be meant


def test_files_of_cameras_in_the_folder_of_the_images(folder: Path, frames) -> None:
    path = metashape(folder, frames.world_to_camera.double().numpy(), 90.0, np.array([55.5, 41.5]))
    path.rename(folder / "images" / path.name)
    assert [picture.source for picture in given_pictures(folder) or []] == [f"cameras.xml {folder / 'images'}"] * 4


def test_files_that_may_have_cameras_are_named_if_they_are_not_read(folder: Path, model, monkeypatch, caplog) -> None:
    """Exports of OpenMVG, Pix4D and others: structure from motion began without a word."""
    names = ("a_calibrated_external_camera_parameters.txt", "export.csv", "notes.txt", "sfm_data.json")
    for name in names:
        (folder / name).write_text("Name,X,Y,Z")
    (folder / "008.xmp").write_text('<x xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation/></x>')
    (folder / "009.xmp").write_text('<x xmlns:crs="http://ns.adobe.com/camera-raw-settings/1.0/"/>')
    monkeypatch.setattr("vg2gt.inputs.cameras.find_cameras", lambda pictures, *_: pictures)
    for poses, said in (("sfm", False), ("auto", True)):
        with pictures_for(model, folder, poses) as pictures:  # type: ignore[arg-type]
            assert len(pictures) == 4
        named = ", ".join(str(folder / name) for name in ("008.xmp", *names) if name != "notes.txt")
        assert (f"not read as cameras: {named} (" in caplog.text) == said


def test_files_that_do_not_fit_are_named(folder: Path, frames, tmp_path: Path) -> None:
    poses = frames.world_to_camera.double().numpy()
    path = metashape(folder, poses, 90.0, np.array([55.5, 41.5]))
    whole = path.read_text()
    for text, said in (
        (whole[: len(whole) // 2], r"cameras\.xml: damaged file of cameras"),
        (whole.replace('type="frame"', 'type="spherical"'), "has the type spherical, which is not read"),
        (whole.replace("<f>90.0</f>", "<f>nan</f>"), "is not finite"),
        (
            whole.replace(f'width="{SIZE[1]}" height="{SIZE[0]}"', f'width="{SIZE[0]}" height="{SIZE[1]}"').replace(
                "<f>", "<k1>0.01</k1><f>"
            ),
            r"008\.png is 112x84 pixels, but its camera is of 84x112",
        ),
        (whole.replace("00", "77").replace("01", "77"), r"cameras\.xml names none of the 4 images"),
    ):
        path.write_text(text)
        with pytest.raises(SystemExit, match=said):
            reconstruct_command.main([str(folder), "--poses", "given", "--out", str(tmp_path / "out"), "--quiet"])
    path.write_text(whole)
    with pytest.raises(SystemExit, match=r"cameras\.xml is a file of cameras.*give the folder of its images"):
        reconstruct_command.main([str(path), "backend=da3_tiny", "--out", str(tmp_path / "out"), "--quiet"])
