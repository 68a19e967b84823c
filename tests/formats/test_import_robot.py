"""Robots from URDF and MJCF: what is taken over agrees with MuJoCo, what is not is named."""

import mujoco
import numpy as np
import pytest
import trimesh

from exports import lake_robot
from laboratory import refusal, write
from mjx_revolve import build_robot, load_modules, load_morphology, load_world
from mjx_revolve.formats import import_robot, make_links, make_meshes, make_mjcf, make_urdf
from mjx_revolve.formats.rigid_links import box_around, closed_volume
from mjx_revolve.importer import main
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.yaml_reader import dump_yaml

WATER = load_world("lake")
# A root whose inertia is turned, a foot fixed to its leg, boxes and cylinders at angles.
URDF = """
<robot name="two legs">
  <link name="base">
    <inertial><origin xyz="0.01 0 -0.02" rpy="0.3 -0.2 0.9"/><mass value="0.4"/>
      <inertia ixx="3e-4" iyy="5e-4" izz="6e-4" ixy="2e-5" ixz="0" iyz="-1e-5"/></inertial>
    <collision><origin rpy="0 0 0.5"/><geometry><box size="0.1 0.06 0.04"/></geometry></collision>
    <visual><geometry><sphere radius="0.03"/></geometry></visual>
  </link>
  <link name="left">
    <inertial><origin xyz="0 0 -0.05"/><mass value="0.1"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="2e-5" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.05" rpy="0.2 0 0"/>
      <geometry><cylinder radius="0.01" length="0.1"/></geometry></collision>
    <collision><origin xyz="0 0 -0.05"/>
      <geometry><box size="0.01 0.02 0.03"/></geometry></collision>
  </link>
  <link name="foot"><inertial><mass value="0.02"/>
    <inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.03 0.02 0.01"/></geometry></collision></link>
  <link name="right"><inertial><mass value="0.1"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="2e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="rod"><inertial><mass value="0.03"/>
    <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision></link>
  <joint name="hip" type="revolute"><parent link="base"/><child link="left"/>
    <origin xyz="0.05 0.02 -0.02" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-0.5" upper="1.2" effort="0.4" velocity="3"/></joint>
  <joint name="ankle" type="fixed"><parent link="left"/><child link="foot"/>
    <origin xyz="0 0 -0.1" rpy="0 0.4 0"/></joint>
  <joint name="other" type="continuous"><parent link="base"/><child link="right"/>
    <origin xyz="-0.05 0 -0.02"/><axis xyz="0.6 0.8 0"/></joint>
  <joint name="slide" type="prismatic"><parent link="right"/><child link="rod"/>
    <origin xyz="0 0 -0.1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <transmission name="t"/>
</robot>
"""
MJCF = """
<mujoco model="walker">
  <compiler angle="degree"/>
  <default><geom contype="1" conaffinity="1" density="800"/></default>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="torso" pos="0 0 1"><freejoint/>
      <geom type="capsule" fromto="-.05 0 0 .05 .02 .03" size=".03"/>
      <body name="thigh" pos="0 .05 -.02" euler="10 20 30">
        <joint name="hip_x" axis="1 0 0" range="-40 60" pos="0 0 .01" actuatorfrcrange="-2 2"/>
        <joint name="hip_y" axis="0 1 0" range="-40 60"/>
        <geom type="box" size=".01 .02 .04" pos="0 0 -.04" euler="0 30 0"/>
        <body name="shin" pos="0 0 -.08">
          <joint name="knee" axis="0 1 0" range="-100 0" ref="-20"/>
          <geom type="ellipsoid" size=".01 .02 .03" pos="0 0 -.03"/>
          <geom type="sphere" size=".02" pos="0 0 -.07"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="knee" gear="3" forcerange="-.5 .5" forcelimited="true"/></actuator>
</mujoco>
"""


def mass_matrices(model, seed=0):
    """Mass matrices at three random angles of the hinges, without the motors' own inertia."""
    data, draw, found = mujoco.MjData(model), np.random.default_rng(seed), []
    for _ in range(3):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7:] = draw.uniform(-0.4, 0.4, model.nq - 7)
        mujoco.mj_forward(model, data)
        whole = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, whole)
        found.append(whole - np.diag(model.dof_armature))
    return np.array(found)


def built(robot):
    return build_robot(robot.morphology, WATER)


@pytest.mark.parametrize("name", ["spider", "fish", "odd", "auv", "salamander"])
@pytest.mark.parametrize("kind", ["robot.urdf", "robot.xml"])
def test_what_is_exported_comes_back(name, kind, tmp_path):
    robot = lake_robot(name)
    (tmp_path / "meshes").mkdir()
    for mesh, shape in make_meshes(robot.morphology).items():
        shape.export(tmp_path / "meshes" / f"{mesh}.stl")
    path = write(tmp_path, (make_urdf if kind == "robot.urdf" else make_mjcf)(robot), kind)
    found = import_robot(path)
    again, near = built(found), {"rtol": 1e-5, "atol": 1e-10}  # MJCF has seven digits
    links = make_links(robot)
    assert len(links) == len(make_links(again))
    for ours, theirs in zip(make_links(again), links, strict=True):
        assert ours.mass == pytest.approx(theirs.mass, rel=2e-6)
        if theirs.joint is not None:
            assert ours.joint.name == theirs.joint.name
            assert ours.joint.range == pytest.approx(theirs.joint.range, rel=1e-5)
            assert ours.joint.effort == pytest.approx(theirs.joint.effort)
            if kind == "robot.urdf":  # MJCF has no such number
                assert ours.joint.speed == pytest.approx(theirs.joint.speed)
    np.testing.assert_allclose(mass_matrices(again.mj_model), mass_matrices(robot.mj_model), **near)
    # Sealed electronics and ballast displace water, and no file says so.
    meshes, layout = make_meshes(robot.morphology), robot.morphology.layout
    volumes, centers = [], []
    for part in (part for link in links for part in link.parts):
        volume, center = closed_volume(np.asarray(meshes[part.mesh].triangles))
        assert volume == pytest.approx(part.part.volume)
        volumes.append(volume)
        centers.append(layout.position[part.row] + layout.rotation[part.row] @ center)
    assert found.morphology.volume == pytest.approx(sum(volumes), rel=1e-4)
    middle = np.array(volumes) @ centers / sum(volumes)
    np.testing.assert_allclose(found.morphology.center_of_volume, middle, atol=5e-6)


def test_a_urdf_of_boxes_and_cylinders(tmp_path):
    path = write(tmp_path, URDF, "robot.urdf")
    found = import_robot(path)
    model = built(found).mj_model
    # MuJoCo has no free base and no rod on its slide: both are given to it.
    text = URDF.replace('type="prismatic"', 'type="fixed"')
    text = text.replace('<link name="base">', '<mujoco><compiler fusestatic="false"/></mujoco>'
              '<link name="world"/><joint name="root" type="floating"><parent link="world"/>'
              '<child link="base"/></joint><link name="base">')  # fmt: skip
    np.testing.assert_allclose(
        mass_matrices(model), mass_matrices(mujoco.MjModel.from_xml_string(text)), rtol=1e-6,
        atol=1e-9,
    )  # fmt: skip
    names = [module.name for module in found.morphology.modules]
    assert names == ["base", "base_1", "hip", "hip_1", "hip_2", "other"]
    hip = found.modules["hip"].hinge
    assert (hip.range, hip.effort, hip.speed) == ((-0.5, 1.2), 0.4, 3.0)
    # A cylinder is a box around it that displaces the cylinder; the base is a visible sphere.
    volumes = [found.modules[name].volume for name in names]
    ball, rod = 4 / 3 * np.pi * 0.03**3, np.pi * 0.01**2 * 0.1
    assert volumes[:2] == pytest.approx([0.0, ball])
    assert sum(volumes[2:5]) == pytest.approx(rod + 6e-6 + 6e-6)
    assert volumes[5] == pytest.approx(1e-6)
    assert found.morphology.center_of_volume == pytest.approx(
        (ball * np.zeros(3) + sum(volumes[2:]) * _center(found, 2)) / sum(volumes), abs=1e-9
    )
    assert found.missing == (
        "slide: a prismatic joint, which is rigid here",
        "1 × <transmission>",
        "other: turns all the way; here from -π to π",
        "other: no effort nor speed given; so Revolve's servo's",
    )


def _center(robot, first):
    """Centre of volume of the modules from one on."""
    layout = robot.morphology.layout
    rows = [
        (part.volume, layout.position[k] + layout.rotation[k] @ part.center_of_volume)
        for k, part in enumerate(layout.parts[i] for i in layout.kind)
        if layout.module[k] >= first
    ]
    return sum(v * x for v, x in rows) / sum(v for v, _ in rows)


def test_an_mjcf_of_capsules_and_two_hinges(tmp_path):
    path = write(tmp_path, MJCF, "robot.xml")
    found = import_robot(path)
    assert found.morphology.name == "walker"
    one = MJCF.replace('<joint name="hip_y" axis="0 1 0" range="-40 60"/>', "")
    one = one.replace('range="-100 0" ref="-20"', 'range="-80 20"')  # angles count from rest here
    theirs = mujoco.MjModel.from_xml_string(one)
    ours = built(found).mj_model
    np.testing.assert_allclose(mass_matrices(ours), mass_matrices(theirs), rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(ours.jnt_range[1:], theirs.jnt_range[1:], atol=1e-9)
    hinges = [found.modules[name].hinge for name in ("hip_x", "knee")]
    assert [hinge.effort for hinge in hinges] == [2.0, 1.5]
    geared = MJCF.replace("forcerange", "ctrlrange").replace("forcelimited", "ctrllimited")
    other = import_robot(write(tmp_path, geared, "geared.xml")).modules["knee"].hinge
    assert other.effort == 1.5
    another = '<motor joint="knee" gear="3" forcerange="-1 .2" forcelimited="true"/></actuator>'
    two = MJCF.replace("</actuator>", another)
    both = import_robot(write(tmp_path, two, "two.xml")).modules["knee"].hinge
    assert both.effort == pytest.approx(4.5)  # they add up, each by its stronger side
    assert found.missing == (
        "hip_y: a joint that is rigid here, as a link has one hinge",
        "1 × geoms of the world",
        "hip_x, knee: no speed given; so Revolve's servo's",
    )
    shin = 4 / 3 * np.pi * (0.01 * 0.02 * 0.03 + 0.02**3)
    assert found.modules["knee"].volume == pytest.approx(shin)


def test_shapes_have_their_volumes():
    for kind, size, edges, volume in (
        ("box", [1, 2, 3], [2, 4, 6], 48), ("sphere", [2], [4, 4, 4], 32 / 3 * np.pi),
        ("ellipsoid", [1, 2, 3], [2, 4, 6], 8 * np.pi),
        ("cylinder", [1, 3], [2, 2, 6], 6 * np.pi),
        ("capsule", [1, 3], [2, 2, 8], (6 + 4 / 3) * np.pi),
    ):  # fmt: skip
        found = box_around(kind, np.array(size, float))
        assert found[0].tolist() == edges and found[1] == pytest.approx(volume)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    volume, center = closed_volume(corners[faces])
    assert volume == pytest.approx(1 / 6) and center == pytest.approx([0.25] * 3)
    for wrong in (faces[:3], faces[:, ::-1]):
        assert closed_volume(corners[wrong]) is None


def test_the_command_writes_what_other_commands_read(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, URDF, "robot.urdf")
    assert main([str(path), "--out", "robots"]) == 0
    said = capsys.readouterr().out
    assert "slide: a prismatic joint" in said and "robots/two_legs.yaml" in said
    modules = load_modules("robots/two_legs_modules.yaml")
    robot = load_morphology("robots/two_legs.yaml", modules)
    assert robot.num_hinges == 2 and robot.mass == pytest.approx(0.65)
    assert robot == import_robot(path).morphology
    assert main([str(path)]) == 0
    with pytest.raises(InputError, match=r"two_legs\.yaml: expected no such file yet"):
        main([str(path)])
    with pytest.raises(InputError, match=r"--out robot\.urdf: expected a folder; found a file"):
        main([str(path), "--out", "robot.urdf"])


@pytest.mark.parametrize(
    "old, new, expected",
    [
("<robot", "<sdf", "expected XML; found: mismatched tag"),
("\n<robot", '<?xml version="1.0" encoding="GB2312"?><robot', "expected XML; found: multi-byte"),
('"0.4"', '"heavy"', "<mass> value: expected 1 numbers; found 'heavy'"),
('"0.4"', '"0"', "base: expected a root with a mass; found none"),
("0.1 0.06 0.04", "0.1 -0.06 0.04", "link base: expected sizes > 0 of a box; found [0.1, -0.06"),
('<child link="left"', '<child link="lft"', "joint hip: expected a link of the file; f"),
("</robot>", '<link name="alone"/></robot>', "expected one root link; found base, alone"),
("</robot>", '<link name="rod"/></robot>', "link rod: expected each name once; found 2 of it"),
('lower="-0.5" upper="1.2"', 'lower="1.2" upper="-0.5"', "hip: expected a range [lowest, highest]; "
 "found [1.2, -0.5]"),
],
)  # fmt: skip
def test_what_is_wrong_is_said_in_a_line(old, new, expected, tmp_path):
    assert old in URDF
    path = write(tmp_path, URDF.replace(old, new, 1), "robot.urdf")
    assert refusal(import_robot, path).startswith(f"{path}: {expected}")


def test_welded_boxes_have_names_of_their_own(tmp_path):
    """Also where a hinge has the name that they would be given: nothing replaces anything."""
    plain_robot = import_robot(write(tmp_path, URDF, "robot.urdf"))
    clash = import_robot(write(tmp_path, URDF.replace('"other"', '"hip_1"'), "clash.urdf"))
    for found in (plain_robot, clash):
        assert found.morphology.num_hinges == 2
        assert found.morphology.mass == pytest.approx(0.65)


def test_what_is_changed_is_named(tmp_path):
    text = URDF.replace('izz="6e-4"', 'izz="60e-4"').replace(
        '<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><dynamics damping="0.1"/>'
    )
    found = import_robot(write(tmp_path, text, "robot.urdf")).missing
    assert "base: an inertia that no body has; the nearest one is taken" in found
    assert "hip: damping and friction; here those of our servos" in found
    damped = (
        MJCF.replace('name="knee"', 'name="knee" damping="1" armature="1e-3"')
        .replace('type="ellipsoid"', 'type="ellipsoid" material="red"')
        .replace("<worldbody>", '<asset><material name="red" rgba="1 0 0 1"/></asset><worldbody>')
    )
    robot = import_robot(write(tmp_path, damped, "robot.xml"))
    assert {"damping of joints", "armatures"} <= {*robot.missing}
    driven = (
        MJCF.replace("</worldbody>", "</worldbody><actuator>__</actuator>")
        .replace("</actuator><actuator>", "")
        .replace("__", '<adhesion body="shin" ctrlrange="0 1"/>')
        .replace('<body name="shin"', '<body name="shin" gravcomp="1"')
    )
    assert {
        "1 × actuators that move no joint, such as thrusters",
        "weights taken off bodies (gravcomp)",
    } <= {*import_robot(write(tmp_path, driven, "robot.xml")).missing}
    assert "red: 1.0, green: 0.0, blue: 0.0" in dump_yaml(robot.files[0], default_flow_style=None)


def test_a_chain_too_long_to_be_read_again_is_refused(tmp_path):
    link = '<link name="l{0}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
    link += 'ixz="0" iyz="0"/></inertial></link>'
    joint = '<joint name="j{0}" type="continuous"><parent link="l{1}"/><child link="l{0}"/></joint>'
    text = "".join(link.format(k) for k in range(120))
    text += "".join(joint.format(k, k - 1) for k in range(1, 120))
    path = write(tmp_path, f"<robot name='long'>{text}</robot>", "long.urdf")
    with pytest.raises(InputError, match=r"long\.urdf: expected at most 200 levels of nesting"):
        import_robot(path)


def test_mirrored_meshes_have_their_volumes(tmp_path):
    mesh = '<mesh filename="ball.stl" scale="1 -1 1"/>'
    path = write(tmp_path, URDF.replace('<sphere radius="0.03"/>', mesh), "robot.urdf")
    ball = trimesh.creation.icosphere(radius=0.03)
    ball.export(tmp_path / "ball.stl")
    found = import_robot(path)
    assert found.modules["base_1"].volume == pytest.approx(ball.volume, rel=1e-5)
    assert not any("holes" in words for words in found.missing)
    # In millimetres, as the file says.
    pytest.importorskip("collada", reason="the package pycollada reads COLLADA")
    text = ball.apply_scale(1e3).export(file_type="dae").decode()
    text = text.replace("</asset>", '<unit meter="0.001" name="millimeter" /></asset>')
    assert text.count("<unit") == 1
    (tmp_path / "ball.dae").write_text(text)
    path.write_text(path.read_text().replace("ball.stl", "ball.dae"))
    assert import_robot(path).modules["base_1"].volume == pytest.approx(
        found.modules["base_1"].volume
    )


@pytest.mark.parametrize(
    "content", [b"", b"solid x\nendsolid x\n", b"solid x\nfacet nor", b"\0" * 84]
)
@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "3mf"])
def test_meshes_that_cannot_be_read_are_named(content, ending, tmp_path):
    mesh = f'<mesh filename="ball.{ending}"/>'
    path = write(tmp_path, URDF.replace('<sphere radius="0.03"/>', mesh), "robot.urdf")
    (tmp_path / f"ball.{ending}").write_bytes(content)
    assert f"base: the mesh ball.{ending}, which cannot be read" in import_robot(path).missing


def test_meshes_that_are_missing_or_open_are_named(tmp_path):
    text = URDF.replace('<sphere radius="0.03"/>', '<mesh filename="package://x/ball.stl"/>')
    found = import_robot(write(tmp_path, text, "robot.urdf"))
    assert found.missing[0] == "base: the mesh package://x/ball.stl, which cannot be read"
    ball = trimesh.creation.icosphere(radius=0.03)
    ball.export(tmp_path / "ball.stl")
    assert import_robot(tmp_path / "robot.urdf").modules["base_1"].volume == pytest.approx(
        ball.volume, rel=1e-5
    )
    trimesh.Trimesh(ball.vertices, ball.faces[5:]).export(tmp_path / "ball.stl")
    found = import_robot(tmp_path / "robot.urdf")
    assert found.missing[0].startswith("base: a mesh with holes; the box around it")
    assert found.modules["base_1"].volume == pytest.approx(0.06**3, rel=1e-2)


def test_what_stands_around_a_robot_is_no_part_of_it(tmp_path):
    """A static pool, a URDF's world link, an eye on a hull."""
    pool = '<body name="pool" pos="0 0 9"><geom type="box" size="4 4 .1"/></body></worldbody>'
    eye = '<body name="torso" pos="0 0 1"><geom size=".002" contype="0" conaffinity="0"/>'
    text = MJCF.replace("</worldbody>", pool).replace('<body name="torso" pos="0 0 1">', eye)
    found, usual = (import_robot(write(tmp_path, x, "robot.xml")) for x in (text, MJCF))
    assert found.morphology.volume == pytest.approx(usual.morphology.volume, rel=1e-3)
    world = '<link name="world"/><joint name="w" type="fixed"><parent link="world"/><child '
    world += 'link="base"/><origin xyz="0 0 5"/></joint><link name="base">'
    found = import_robot(write(tmp_path, URDF.replace('<link name="base">', world), "robot.urdf"))
    assert found.morphology == import_robot(write(tmp_path, URDF, "robot.urdf")).morphology


def test_an_eye_that_is_fixed_to_a_hull_without_a_visual_does_not_stand_for_it(tmp_path):
    eye = '<link name="eye"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>'
    eye += '<joint name="at" type="fixed"><parent link="left"/><child link="eye"/></joint>'
    volumes = [
        import_robot(write(tmp_path, text, "a.urdf")).morphology.volume
        for text in (URDF, URDF.replace("</robot>", f"{eye}</robot>"))
    ]
    assert volumes[1] == pytest.approx(volumes[0] + 4 / 3 * np.pi * 0.01**3)
