# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from vitamin3d.errors import InputError, OutputError
from vitamin3d.exporters.depth_map import write_png
from vitamin3d.exporters.mesh import obj_text, read_ply, write_cloud_ply, write_obj, write_ply
from vitamin3d.types import PointCloud, Surface

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


def test_ply_comes_back(surface, tmp_path):
    write_ply(surface, tmp_path / "a.ply", ["unit: metre", "two\nlines"])
    back = read_ply(tmp_path / "a.ply")
    for name in ("vertices_world", "triangles", "normals_world", "colors"):
        np.testing.assert_array_equal(getattr(back, name), getattr(surface, name))
    assert b"\ncomment unit: metre\ncomment two\ncomment lines\n" in (tmp_path / "a.ply").read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(("write", "name"), [(write_ply, "a.ply"), (write_obj, "a.obj")])
def test_open3d_reads_meshes(write, name, surface, tmp_path):
    write(surface, tmp_path / name, ["a comment"])
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(str(tmp_path / name))
    corners = np.asarray(mesh.triangles)  # Open3D numbers the vertices of an OBJ anew
    np.testing.assert_allclose(np.asarray(mesh.vertices)[corners], surface.vertices_world[surface.triangles])
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals)[corners], surface.normals_world[surface.triangles])
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors)[corners], surface.colors[surface.triangles] / 255.0, atol=1e-3)


def test_obj_text(surface, tmp_path):
    write_obj(surface, tmp_path / "a.obj", ["a comment"])
    lines = (tmp_path / "a.obj").read_text().splitlines()
    assert lines[:3] == ["# a comment", "mtllib a.mtl", "v -1 -1 2 0 0.502 1"]
    assert (tmp_path / "a.mtl").read_text().splitlines()[:3] == ["newmtl vertex_colors", "Ka 1 1 1", "Kd 1 1 1"]
    assert lines[6] == "vn 0 0 -1" and lines[-1] == "f 1//1 4//4 3//3"


def test_faces_of_an_obj():
    triangles = np.array([[0, 8, 9], [98, 99, 100], [2147483646, 1234567, 0]], np.int32)
    mesh = Surface(np.zeros((0, 3)), triangles, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    lines = b"".join(obj_text(mesh, [], "a.mtl")).decode().splitlines()[2:]
    assert lines == ["f " + " ".join(f"{n + 1}//{n + 1}" for n in row) for row in triangles.tolist()]


def test_meshlab_reads_the_colours_of_an_obj(surface, tmp_path):
    pymeshlab = pytest.importorskip("pymeshlab")
    write_obj(surface, tmp_path / "a.obj", [])
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / "a.obj"))
    mesh = meshes.current_mesh()
    corners = np.asarray(mesh.face_matrix())
    np.testing.assert_allclose(mesh.vertex_matrix()[corners], surface.vertices_world[surface.triangles])
    np.testing.assert_allclose(mesh.vertex_color_matrix()[corners][..., :3], surface.colors[surface.triangles] / 255.0, atol=0.005)


def test_clouds_keep_all_properties(tmp_path):
    rng = np.random.default_rng(0)
    quality = [rng.random(5).astype(np.float32) for _ in range(3)]
    cloud = PointCloud(rng.random((5, 3)), rng.integers(0, 255, (5, 3)).astype(np.uint8), np.arange(5, dtype=np.int32), *quality)
    write_cloud_ply(cloud, tmp_path / "c.ply", ["parallax > 1 degree"])
    import open3d as o3d

    read = o3d.t.io.read_point_cloud(str(tmp_path / "c.ply")).point
    np.testing.assert_allclose(read.positions.numpy(), cloud.points_world, rtol=1e-6)
    np.testing.assert_array_equal(read.colors.numpy(), cloud.colors)
    for name in ("num_observations", "parallax_deg", "reprojection_rms_px", "depth_deviation"):
        np.testing.assert_array_equal(read[name].numpy().ravel(), getattr(cloud, name))


@pytest.mark.parametrize("content", [b"", b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n", b"\xff\x00" * 50])
def test_foreign_files_are_refused(content, tmp_path):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.ply"):
        read_ply(tmp_path / "a.ply")


def test_cut_and_missing_files_are_refused(surface, tmp_path):
    with pytest.raises(InputError, match=r"none\.ply"):
        read_ply(tmp_path / "none.ply")
    write_ply(surface, tmp_path / "a.ply", [])
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    with pytest.raises(InputError, match="cut short"):
        read_ply(tmp_path / "a.ply")


def test_folders_that_cannot_be_written_are_named(surface, tmp_path):
    (tmp_path / "file").write_text("")
    for folder in ("missing", "file"):
        with pytest.raises(OutputError, match=rf"{folder}/a\.ply: cannot be written"):
            write_ply(surface, tmp_path / folder / "a.ply", [])
        with pytest.raises(OutputError, match=rf"{folder}/a\.png: cannot be written"):
            write_png(np.zeros((2, 2), np.uint8), tmp_path / folder / "a.png")


def test_a_full_disk_leaves_the_old_file_and_no_other(surface, tmp_path, monkeypatch):
    write_ply(surface, tmp_path / "a.ply", [])
    before = (tmp_path / "a.ply").read_bytes()

    def fail(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_ply(surface, tmp_path / "a.ply", ["longer"])
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"] and (tmp_path / "a.ply").read_bytes() == before
