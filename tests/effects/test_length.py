"""Stretched links equal recompiled ones."""

from itertools import pairwise
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from sb3_rpto.effects import LIBRARY, Declared
from sb3_rpto.effects.batch import LiveSimulation, MujocoBatch
from sb3_rpto.effects.inertia import from_tensor, matrices, to_tensor
from sb3_rpto.effects.length import link_length, write_length

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
LINKS = [
    ("half_cheetah.xml", "bthigh"),
    ("half_cheetah.xml", "torso"),  # two capsules in two directions, eight children
    ("hopper.xml", "leg"),  # its origin is its middle
    ("hopper.xml", "torso"),
    ("walker2d_v5.xml", "leg"),
    ("inverted_double_pendulum.xml", "pole"),
    ("swimmer.xml", "mid"),
]


def recompiled(path: Path, name: str, scale: float) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """The model, and one compiled from a spec whose link is ``scale`` as long along its longest capsule."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.settotalmass = -1
    model = spec.compile()
    body = model.body(name).id
    first, count = model.body_geomadr[body], model.body_geomnum[body]
    geoms = range(first, first + count)
    axes = matrices(model.geom_quat)[:, :, 2]
    longest = max((g for g in geoms if model.geom_type[g] == CAPSULE), key=lambda g: model.geom_size[g, 1])
    stretch = np.eye(3) + (scale - 1) * np.outer(axes[longest], axes[longest])
    link = spec.body(name)
    for geom, g in zip(link.geoms, geoms, strict=True):
        half = model.geom_size[g, 1] * axes[g]
        geom.fromto = [*(stretch @ (model.geom_pos[g] - half)), *(stretch @ (model.geom_pos[g] + half))]
        geom.pos, geom.quat = [0, 0, 0], [1, 0, 0, 0]

    def joined(body: mujoco.MjsBody) -> np.ndarray:
        """From a body's origin to where it turns, in its parent's frame."""
        turning = [j.pos for j in body.joints if j.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)]
        return matrices(model.body_quat[model.body(body.id).id][None])[0] @ turning[0] if turning else np.zeros(3)

    for child in link.bodies:
        child.pos = stretch @ (child.pos + joined(child)) - joined(child)
    rotation, before = matrices(model.body_quat[body][None])[0], joined(link)
    for thing in (*link.joints, *link.sites):
        thing.pos = stretch @ thing.pos
    link.pos = link.pos + before - rotation @ stretch @ rotation.T @ before
    return model, spec.compile()


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize("scale", [0.7, 1.3])
@pytest.mark.parametrize(("file", "name"), LINKS)
def test_stretched_equals_recompiled(file: str, name: str, scale: float) -> None:
    model, expected = recompiled(ASSETS / file, name, scale)
    body = model.body(name).id
    nominal = link_length(model, body)
    batch = MujocoBatch(model, 2, 1)
    outputs = {n: batch.engine.bind(n) for n in ("qacc", "geom_xpos", "site_xpos", "xanchor")}
    write_length(batch, body, np.array([nominal, scale * nominal]), nominal)
    batch.settle()

    np.testing.assert_allclose(link_length(expected, body), scale * nominal, rtol=1e-12)
    for field in ("body_mass", "body_ipos", "body_subtreemass", "geom_size", "geom_pos", "geom_rbound", "body_pos"):
        np.testing.assert_allclose(batch.field(field)[1], getattr(expected, field), rtol=1e-9, atol=1e-12)
    tensor = to_tensor(batch.field("body_inertia")[1], batch.field("body_iquat")[1])
    np.testing.assert_allclose(tensor, to_tensor(expected.body_inertia, expected.body_iquat), rtol=1e-9, atol=1e-12)
    for field in ("body_mass", "body_ipos", "body_iquat", "body_inertia", "geom_quat", "jnt_pos"):
        assert np.array_equal(batch.field(field)[0], getattr(model, field)), "the nominal length changes nothing"

    rng = np.random.default_rng(0)
    data = mujoco.MjData(expected)
    for _ in range(5):
        data.qpos[:], data.qvel[:] = model.qpos0 + 0.3 * rng.normal(size=model.nq), rng.normal(size=model.nv)
        batch.qpos[:], batch.qvel[:] = data.qpos, data.qvel
        data.qacc_warmstart[:] = 0
        mujoco.mj_forward(expected, data)
        batch.engine.forward()
        for output, values in outputs.items():
            # Contacts amplify rounding.
            np.testing.assert_allclose(values[1], getattr(data, output), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_distances_between_joints_are_scaled(scale: float) -> None:
    """Hopper's bodies have their origins away from their joints, and its torso slides on rails 1.25 m below it."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "hopper.xml"))
    before, data = mujoco.MjData(model), mujoco.MjData(model)
    mujoco.mj_forward(model, before)
    batch = LiveSimulation(model, data)
    for name in ("torso", "thigh", "leg", "foot"):
        nominal = link_length(model, model.body(name).id)
        write_length(batch, model.body(name).id, np.array([scale * nominal]), nominal)
    batch.settle()
    mujoco.mj_forward(model, data)
    joints = [model.joint(name).id for name in ("rooty", "thigh_joint", "leg_joint", "foot_joint")]
    for one, next_one in pairwise(joints):
        np.testing.assert_allclose(
            data.xanchor[next_one] - data.xanchor[one],
            scale * (before.xanchor[next_one] - before.xanchor[one]),
            atol=1e-12,
        )
    np.testing.assert_array_equal(data.body("torso").xpos, before.body("torso").xpos)
    sole = data.geom("foot_geom").xpos - data.xanchor[joints[-1]]
    np.testing.assert_allclose(sole, (before.geom("foot_geom").xpos - before.xanchor[joints[-1]]) * (scale, 1, 1))


def test_inertia_of_offset_balls_and_boxes() -> None:
    """Geoms that are no capsules move with the link and keep their size; the density is the body's."""
    xml = """<mujoco><worldbody><body name="b"><joint axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 {0}" size="0.03"/>
    <geom type="sphere" pos="0.1 0 {0}" size="0.06"/>
    <geom type="box" pos="0 0.1 {1}" size="0.02 0.03 0.05" euler="20 0 0"/>
    <geom type="cylinder" pos="0 0 {1}" size="0.05 0.02"/>
    <geom type="ellipsoid" pos="0 0 {1}" size="0.05 0.02 0.07"/>
    </body></worldbody></mujoco>"""
    model, longer = (mujoco.MjModel.from_xml_string(xml.format(0.4 * s, 0.2 * s)) for s in (1, 1.5))
    batch = MujocoBatch(model, 1, 1)
    write_length(batch, 1, np.array([0.6]), 0.4)
    np.testing.assert_allclose(batch.field("body_mass")[0], longer.body_mass, rtol=1e-12)
    np.testing.assert_allclose(batch.field("body_ipos")[0], longer.body_ipos, atol=1e-12)
    np.testing.assert_allclose(
        to_tensor(batch.field("body_inertia")[0, 1:], batch.field("body_iquat")[0, 1:]),
        to_tensor(longer.body_inertia[1:], longer.body_iquat[1:]),
        rtol=1e-9,
        atol=1e-12,
    )


def test_a_body_without_capsule_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="ball"><joint/><geom size="0.1"/></body></worldbody></mujoco>'
    )
    assert link_length(model, 1) == 0
    with pytest.raises(ValueError, match=r"ball\.length is 0 in the model"):
        Declared(model, "ball.length")
    with pytest.raises(ValueError, match="no capsule to stretch"):
        LIBRARY["link_length"]("ball").bind(model)
    assert LIBRARY["link_length"].places(model) == []


def test_declared_length_and_effect_are_the_same() -> None:
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "inverted_double_pendulum.xml"))
    declared, effect = Declared(model, "pole.length"), LIBRARY["link_length"]("pole")
    effect.bind(model)
    batches = MujocoBatch(model, 1, 1), MujocoBatch(model, 1, 1)
    declared.write(batches[0], np.array([[0.72]]))
    effect.write(batches[1], np.array([[0.2]]))
    for field in ("body_mass", "body_inertia", "body_pos", "geom_size"):
        np.testing.assert_allclose(batches[0].field(field), batches[1].field(field), rtol=1e-12)
    assert batches[0].field("body_pos")[0, 3, 2] == pytest.approx(0.72)


def test_principal_frames_invert() -> None:
    rng = np.random.default_rng(1)
    tensor = rng.normal(size=(20, 3, 3))
    tensor = tensor @ np.swapaxes(tensor, 1, 2) + np.eye(3)
    moments, quat = from_tensor(tensor)
    np.testing.assert_allclose(to_tensor(moments, quat), tensor, rtol=1e-10, atol=1e-12)
    assert (np.diff(moments, axis=1) <= 0).all()
    for q, matrix in zip(quat, matrices(quat)):
        expected = np.empty(9)
        mujoco.mju_quat2Mat(expected, q)
        np.testing.assert_allclose(matrix.ravel(), expected, atol=1e-14)


def test_principal_frames_are_kept_where_they_are_principal() -> None:
    rng = np.random.default_rng(2)
    near = rng.normal(size=(4, 4))
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    moments = np.array([(1.0, 1.0, 0.3), (0.2, 0.7, 0.7), (1.0, 2.0, 2.5), (1.0, 1.0, 1.0)])
    tensor = to_tensor(moments, near)
    kept, quat = from_tensor(tensor, near)
    np.testing.assert_allclose(kept, moments)
    np.testing.assert_array_equal(quat, near)
    turned = np.roll(near, 1, axis=0)
    np.testing.assert_allclose(to_tensor(*from_tensor(tensor, turned)), tensor, atol=1e-12)
    assert not np.array_equal(from_tensor(tensor, turned)[1][:3], turned[:3])


def test_drag_does_not_jump_with_the_length() -> None:
    """A capsule is a body of revolution: which of its principal frames is taken decides on MuJoCo's drag."""
    model = mujoco.MjModel.from_xml_path(str(ASSETS / "swimmer.xml"))
    accelerations = []
    for scale in (0.87, 0.8703, 0.87035):  # at 0.8703 rounding turns the frame that an eigensolver finds
        stretched, data = model.__copy__(), mujoco.MjData(model)
        batch = LiveSimulation(stretched, data)
        for body in (1, 2, 3):
            write_length(batch, body, np.array([scale * link_length(model, body)]), link_length(model, body))
        batch.settle()
        data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
        mujoco.mj_forward(stretched, data)
        accelerations.append(data.qacc.copy())
    np.testing.assert_allclose(accelerations[1:], accelerations[:1] * 2, atol=0.01)


@pytest.mark.parametrize(
    ("ends", "refused"),
    [
        ('body1="left" body2="right" anchor="0 0 -.5"', True),
        ('site1="end of left" site2="end of right"', False),
    ],
)
def test_a_link_that_a_constraint_holds_by_its_body_is_refused(ends: str, refused: bool) -> None:
    link = (
        '<body name="{0}" pos="{1} 0 0"><joint name="{0}" axis="0 1 0"/>'
        '<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5"/><site name="end of {0}" pos="0 0 -.5"/></body>'
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{link.format('left', 0)}{link.format('right', 0.1)}</worldbody>"
        f'<equality><connect name="pin" {ends}/></equality></mujoco>'
    )
    assert LIBRARY["link_length"].places(model) == ([] if refused else ["left", "right"])
    if not refused:
        assert Declared(model, "left.length").nominal == pytest.approx(0.5)
        return
    with pytest.raises(ValueError, match=r"left\.length: pin names the body.*by sites"):
        Declared(model, "left.length")
    with pytest.raises(ValueError, match="pin names the body"):
        LIBRARY["link_length"]("left").bind(model)
