# SPDX-License-Identifier: Apache-2.0
"""Clouds and meshes as other systems write them, checked against Open3D's writer, and one line for each damaged file."""

import numpy as np
import pytest

from vitamin3d.datasets.point_files import read_geometry
from vitamin3d.errors import InputError
from vitamin3d.exporters.mesh import write_cloud_ply, write_ply
from vitamin3d.types import PointCloud, Surface

pytestmark = pytest.mark.filterwarnings("ignore:Open3D was built with CUDA:ImportWarning")


@pytest.fixture
def points(rng):
    return rng.standard_normal((50, 3)).astype(np.float32).astype(np.float64)


def cloud_of(points):
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize(("ascii", "compressed"), [(True, False), (False, False), (False, True)])
def test_clouds_of_open3d(points, tmp_path, suffix, ascii, compressed):
    import open3d as o3d

    cloud = cloud_of(points)
    cloud.normals = o3d.utility.Vector3dVector(points[::-1])
    path = tmp_path / f"cloud{suffix}"
    assert o3d.io.write_point_cloud(str(path), cloud, write_ascii=ascii, compressed=compressed)
    np.testing.assert_allclose(read_geometry(path).points, points, rtol=1e-5, atol=1e-6)


def test_repetitive_clouds_are_unpacked(tmp_path):
    """LZF's long copies, which overlap themselves."""
    import open3d as o3d

    points = np.zeros((500, 3))
    points[:, 0] = np.arange(500) % 3
    assert o3d.io.write_point_cloud(str(tmp_path / "c.pcd"), cloud_of(points), write_ascii=False, compressed=True)
    np.testing.assert_array_equal(read_geometry(tmp_path / "c.pcd").points, points)


@pytest.mark.parametrize(("ascii", "compressed"), [(True, False), (False, False), (False, True)])
def test_the_colours_of_pcd_are_read_and_a_cut_is_noticed(points, tmp_path, ascii, compressed, capfd):
    import open3d as o3d

    cloud, path = cloud_of(points), tmp_path / "c.pcd"
    colors = (np.abs(points) * 1000 % 255).astype(np.uint8)
    cloud.colors = o3d.utility.Vector3dVector(colors / 255.0)
    assert o3d.io.write_point_cloud(str(path), cloud, write_ascii=ascii, compressed=compressed)
    np.testing.assert_allclose(read_geometry(path).colors, colors, atol=1)
    data = path.read_bytes()
    for size in range(len(data) // 3, len(data) - 12, 37):
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"c\.pcd: damaged.*cut short"):
            read_geometry(path)
    assert capfd.readouterr() == ("", "")


def test_pcd_of_doubles_with_other_fields(points, tmp_path):
    table = np.zeros(50, [("label", "<u2"), ("z", "<f8"), ("y", "<f8"), ("pad", "<u1", (3,)), ("x", "<f8")])
    for k, name in enumerate("xyz"):
        table[name] = 1e-9 + points[:, k]
    head = "FIELDS label z y _ x\nSIZE 2 8 8 1 8\nTYPE U F F U F\nCOUNT 1 1 1 3 1\nWIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA binary\n"
    (tmp_path / "c.pcd").write_bytes(head.encode() + table.tobytes())
    np.testing.assert_array_equal(read_geometry(tmp_path / "c.pcd").points, 1e-9 + points)


def test_our_own_clouds_and_meshes(points, tmp_path):
    colors, column = np.arange(150, dtype=np.uint8).reshape(50, 3), np.ones(50)
    write_cloud_ply(PointCloud(points, colors, column, column, column, column), tmp_path / "cloud.ply", ["scale: none"])
    triangles = np.arange(48, dtype=np.int32).reshape(16, 3)
    write_ply(Surface(points, triangles, points, colors), tmp_path / "mesh.ply", ["a mesh"])
    for name in ("cloud.ply", "mesh.ply"):
        found, data = read_geometry(tmp_path / name), (tmp_path / name).read_bytes()
        np.testing.assert_array_equal(found.points, points)
        np.testing.assert_array_equal(found.colors, colors)
        assert found.colors.dtype == np.uint8 and found.outliers == 0 and found.is_mesh == (name == "mesh.ply")
        (tmp_path / name).write_bytes(data[:-1])
        with pytest.raises(InputError, match="cut short"):
            read_geometry(tmp_path / name)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_meshes_of_open3d(tmp_path, suffix):
    import open3d as o3d

    box = o3d.geometry.TriangleMesh.create_box()
    assert o3d.io.write_triangle_mesh(str(tmp_path / f"box{suffix}"), box, write_vertex_normals=False)
    found = read_geometry(tmp_path / f"box{suffix}")
    assert found.is_mesh
    np.testing.assert_allclose(found.points, np.asarray(box.vertices))
    np.testing.assert_array_equal(found.triangles, np.asarray(box.triangles))


XYZ = "property float x\nproperty float y\nproperty float z\n"
HEAD = b"ply\nformat %s 1.0\nelement vertex %d\n%send_header\n"


def ply(path, body, count=3, extra="", order="ascii"):
    path.write_bytes(f"ply\nformat {order} 1.0\ncomment c\nelement vertex {count}\n{XYZ}{extra}end_header\n".encode() + body)
    return path


def test_polygons_become_fans_and_colours_are_read(tmp_path):
    extra = "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\nproperty list uchar int vertex_indices\n"
    body = b"0 0 0 1 2 3\n1 0 0 4 5 6\n1 1 0 7 8 9\n0 1 0 10 11 12\n4 0 1 2 3\n"
    found = read_geometry(ply(tmp_path / "quad.ply", body, 4, extra))
    assert found.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert found.colors.tolist()[3] == [10, 11, 12]
    faces = np.array([4, 0, 1, 2, 3, 3, 0, 1, 3], ">i4")
    data = b"".join([faces[0:1].astype("u1").tobytes(), faces[1:5].tobytes(), faces[5:6].astype("u1").tobytes(), faces[6:].tobytes()])
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], ">f4").tobytes()
    extra = "element face 2\nproperty list uchar int vertex_index\n"
    found = read_geometry(ply(tmp_path / "big.ply", vertices + data, 4, extra, "binary_big_endian"))
    assert found.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 3]]


@pytest.mark.parametrize("order", ["ascii", "binary_big_endian"])
@pytest.mark.parametrize("polygon", [[0, 1, 2, 99_999_999], [0, 1, 2, -5], [0, 1, 4]])
def test_a_corner_that_is_not_there_is_one_line(tmp_path, polygon, order):
    vertices, size = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), len(polygon)
    body = vertices.astype(">f4").tobytes() + bytes([size]) + np.array(polygon, ">i4").tobytes()
    if order == "ascii":
        body = " ".join(str(number) for number in [*vertices.ravel(), size, *polygon]).encode()
    with pytest.raises(InputError, match=r"bad\.ply: damaged"):
        read_geometry(ply(tmp_path / "bad.ply", body, 4, "element face 1\nproperty list uchar int vertex_indices\n", order))


def test_flat_and_bent_polygons_are_read(tmp_path):
    """And the lists of faces that are no corners; Open3D gives up each of these meshes."""
    body = b"0 0 0\n1 0 0\n2 0 0\n3 0 1\n" + b"2 .1 .2 4 0 1 2 3 7\n0 4 0 2 1 3 7\n0 0 7\n2 .1 .2 2 0 1 7\n"
    extra = "element face 4\nproperty list uchar float texcoord\nproperty list uchar int vertex_indices\nproperty int label\n"
    found = read_geometry(ply(tmp_path / "flat.ply", body, 4, extra))
    assert found.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 1, 3]]


def test_text_of_orb_slam(tmp_path):
    (tmp_path / "MapPoints.txt").write_text(" 0.1 0.2 0.3\n 1 2 3\n-1 -2 -3\n")
    (tmp_path / "points.csv").write_text("x,y,z,id\n0.1,0.2,0.3,7\n1,2,3,8\n-1,-2,-3,9\n")
    a, b = read_geometry(tmp_path / "MapPoints.txt"), read_geometry(tmp_path / "points.csv")
    assert a.points.tolist() == b.points.tolist() == [[0.1, 0.2, 0.3], [1, 2, 3], [-1, -2, -3]]
    assert not a.is_mesh


def test_stray_points_are_left_out_and_counted(points, tmp_path):
    far = np.vstack([np.tile(points, (4, 1)), [[2000.0, 0, 0], [np.nan, 0, 0]]])
    np.savetxt(tmp_path / "far.xyz", far)
    found = read_geometry(tmp_path / "far.xyz")
    assert (len(found.points), found.outliers) == (200, 2)


def test_triangles_of_strays_go_with_them(tmp_path):
    body = b"".join(f"{k % 8} {k // 8} 0\n".encode() for k in range(64)) + b"5000 0 0\n3 0 1 8\n3 0 1 64\n"
    found = read_geometry(ply(tmp_path / "m.ply", body, 65, "element face 2\nproperty list uchar int vertex_indices\n"))
    assert found.triangles.tolist() == [[0, 1, 8]] and found.outliers == 1


def test_a_cloud_that_really_is_long_keeps_its_end(rng):
    """A tenth of the points far away is a shape, not an outlier."""
    from vitamin3d.datasets.point_files import NO_TRIANGLES, Geometry, without_outliers

    points = np.vstack([0.01 * rng.standard_normal((95, 3)), np.array([100.0, 0, 0]) + rng.standard_normal((5, 3))])
    assert without_outliers(Geometry(points, NO_TRIANGLES), None).outliers == 0


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("empty.ply", HEAD % (b"ascii", 0, XYZ.encode()), "empty cloud"),
        ("empty.xyz", b"", "empty cloud"),
        ("nothing.ply", b"", "empty cloud"),
        ("scale_zero.xyz", b"1 2 3\n" * 5, "all points are the same"),
        ("two.xyz", b"1 2 3\n4 5 6\n", "2 of its 2 points"),
        ("no.ply", b"hello", "not a PLY"),
        ("flat.ply", HEAD % (b"ascii", 1, b"property float x\n") + b"1\n", "x, y and z"),
        ("odd.ply", HEAD % (b"ascii", 1, b"property half x\n") + b"1\n", "damaged"),
        ("cut.ply", HEAD % (b"binary_little_endian", 9, XYZ.encode()) + b"12", "cut short"),
        ("cut.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n123", "cut short"),
        ("cut_text.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 3\nDATA ascii\n1 2 3\n4 5 6\n7", "cut short"),
        ("words.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 x3\n", "damaged"),
        ("abc.pcd", b"FIELDS a b c\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 3\n", "x, y and z"),
        ("odd.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE Q F F\nPOINTS 1\nDATA ascii\n1 2 3\n", "damaged"),
        ("empty.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA ascii\n", "empty cloud"),
        ("no.pcd", b"hello", "damaged"),
        ("cut_text.ply", HEAD % (b"ascii", 2, XYZ.encode()) + b"1 2 3\n4 5", "cut short"),
        ("wide.ply", HEAD % (b"ascii", 2, XYZ.encode()) + b"1 2 3 9\n4 5 6 9\n", "damaged"),
        ("no.obj", b"hello", "empty cloud"),
        ("cut.obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 4\n", "damaged"),
        ("nan.xyz", b"nan nan nan\nnan 1 2\ninf 1 2\n", "finite"),
        ("words.txt", b"hello world again\nhello world again\n", "not a cloud"),
        ("tum.txt", b"1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n", "a trajectory, not a cloud"),
        ("binary.txt", bytes(range(256)), "damaged"),
    ],
)  # fmt: skip
def test_damaged_files_are_one_line(tmp_path, name, data, words, capfd):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_geometry(tmp_path / name)
    said = str(caught.value).removeprefix(f"{tmp_path / name}: ")
    assert words in said != str(caught.value) and "\n" not in said
    assert capfd.readouterr() == ("", ""), "the libraries are silent"


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(InputError, match="none"):
        read_geometry(tmp_path / "none.ply")
