"""What of a model no effect acts on is named where a trace leaves something, and nothing else is advised there."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from simulated import PENDULUM, briefly, compiled, recorded

from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.findings import Finding, FindingKind, Hint, listed
from sb3_rpto.sysid.problem.data_model_consistency import check_against, soft_ties
from sb3_rpto.sysid.problem.unsupported_elements import mocap_bodies, unreached, weigh_hints

LINK = '<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.3" mass="1" contype="0" conaffinity="0"/>'
HINGE = '<joint name="hinge" axis="0 1 0" damping=".05" armature=".01"/>'
POLE = f'<body name="pole">{HINGE}{LINK}<site name="tip" pos="0 0 -.3"/></body>'
ARM = f"""<body name="arm"><joint name="sh" type="ball" armature=".01" damping="{{}}"/>{LINK}</body>"""
BALL_MOTORS = "".join(
    f'<motor name="m{a}" joint="sh" gear="{g}"/>' for a, g in zip("xyz", ("1 0 0", "0 1 0", "0 0 .3"))
)
DRONE = '<body name="drone"><freejoint name="root"/><geom size=".1" mass="1"/><site name="rotor" pos=".1 0 0"/></body>'
HAND = '<body name="hand" mocap="true" pos="0 0 -.3">{}</body>'
OTHER = f'<body name="other" pos="1 0 0"><joint name="second" axis="0 1 0"/>{LINK}<site name="far"/></body>'
CLOTH = """<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2" mass="1" radius=".01">
<edge equality="true"/></flexcomp>"""


def model_of(bodies: str = POLE, rest: str = "", extension: str = "") -> str:
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>{extension}
<worldbody>{bodies}</worldbody>{rest}</mujoco>"""


def acting(actuator: str) -> str:
    return f"<actuator>{actuator}</actuator>"


@pytest.mark.parametrize(
    ("xml", "named"),
    [
        (PENDULUM, []),
        (model_of(rest=acting('<position joint="hinge" kp="5"/><pid joint="hinge" input="pos" kp="1"/>')), []),
        (model_of(rest=acting('<dcmotor joint="hinge" motorconst=".3 .3" resistance="1"/>')), []),
        (model_of(rest=acting('<motor joint="hinge" gear="2"/>')), []),
        (model_of(ARM.format(0)), ["ball joint 'sh'"]),
        (model_of(ARM.format(0), acting(BALL_MOTORS)), ["ball joint 'sh'"]),
        (
            model_of(DRONE, acting('<motor name="thrust" site="rotor" gear="0 0 1 0 0 .1"/>')),
            ["free joint 'root'", "actuator at a site 'thrust'"],
        ),
        (model_of(POLE + HAND.format("")), []),
        (model_of(POLE + HAND.format(LINK)), []),
        (
            model_of(POLE + HAND.format(""), '<equality><weld body1="hand" body2="pole"/></equality>'),
            ["mocap body 'hand'", "weld of 'pole' and 'hand'"],
        ),
        (
            model_of(POLE + OTHER, '<equality><joint name="tie" joint1="hinge" joint2="second"/></equality>'),
            ["joint equality 'tie'"],
        ),
        (model_of(rest='<equality><connect active="false" body1="pole" anchor="0 0 0"/></equality>'), []),
        (
            model_of(rest='<equality><connect body1="pole" anchor="0 0 0"/></equality>'),
            ["connect of 'pole'"],
        ),
        (
            model_of(
                POLE + OTHER,
                '<tendon><fixed name="belt" damping="1"><joint joint="hinge" coef="1"/>'
                '<joint joint="second" coef="-1"/></fixed></tendon><actuator><motor tendon="belt"/></actuator>',
            ),
            ["tendon 'belt'"],
        ),
        (
            model_of(
                POLE + OTHER, '<tendon><spatial name="rope"><site site="tip"/><site site="far"/></spatial></tendon>'
            ),
            ["tendon 'rope'"],
        ),
        (
            model_of(POLE + OTHER, acting('<general name="rod" cranksite="tip" slidersite="far" cranklength=".5"/>')),
            ["slider-crank 'rod'"],
        ),
        (model_of(rest=acting('<adhesion name="cup" body="pole" ctrlrange="0 1"/>')), ["adhesion 'cup'"]),
        (
            model_of(rest=acting('<muscle name="pull" joint="hinge" lengthrange="0 1"/>')),
            ["muscle 'pull'"],
        ),
        (
            model_of(
                rest=acting(
                    '<dcmotor name="d" joint="hinge" motorconst=".3 .3" resistance="1" input="pos" controller="9"/>'
                )
            ),
            ["regulated dcmotor 'd'"],
        ),
        (
            model_of(
                rest='<tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>'
                '<equality><tendon name="tie" tendon1="t"/></equality>'
            ),
            ["tendon equality 'tie'", "tendon 't'"],
        ),
        (model_of(POLE + CLOTH), ["flex equality of ", "flex 'cloth'"]),
    ],
)
def test_what_nothing_acts_on_is_listed(xml: str, named: list[str]) -> None:
    model = compiled(xml)
    said = [str(thing) for thing in unreached(model)]
    assert len(said) == len(named)
    assert all(one.startswith(start) for one, start in zip(said, named))
    findings = weigh_hints(model, [], ratio=10.0)
    assert [f.kind for f in findings] == ["beyond the library"] * bool(named)
    for name in named:
        assert name.split(" of ")[0].split(" '")[0] in findings[0].message


def test_many_of_a_kind_are_counted() -> None:
    assert listed(["'a'"]) == "'a'"
    assert listed(["'a'", "'b'", "'c'"]) == "'a', 'b' and 'c'"
    assert listed([*"abcdefgh"]) == "a, b, c, d, e, f and 2 more"


def test_a_hint_is_withheld_beside_what_nothing_acts_on_unless_it_leaves_nothing() -> None:
    free = f'<body name="toy" pos="2 0 0"><joint name="wheel" axis="0 0 1"/>{LINK}</body>'
    model = compiled(model_of(ARM.format(0) + free))
    arm, toy = (frozenset({model.body(name).id}) for name in ("arm", "toy"))
    for bodies, left, told in (
        (arm, 0.36, False),
        (None, 0.36, False),
        (arm, np.inf, False),
        (toy, 0.36, True),
        (arm, 0.03, True),
        (None, 0.03, True),
    ):
        hint = Hint(FindingKind.UNDECLARED_MASS, "arm", "declare arm.mass", bodies=bodies, left=left)
        found = weigh_hints(model, [hint], ratio=37.0)
        assert (hint in found) == told
        assert ("beyond the library" in [f.kind for f in found]) == (bodies == toy or not told)
    other = Finding(FindingKind.TIME_STEP, "the model", "errs less in finer steps")
    assert other in weigh_hints(model, [other], ratio=37.0)
    plain = Hint(FindingKind.UNDECLARED_MASS, "pole", "declare pole.mass", bodies=frozenset({1}), left=0.36)
    assert weigh_hints(compiled(), [plain], ratio=37.0) == [plain]


@pytest.mark.parametrize(
    ("xml", "said"),
    [
        (model_of(POLE + HAND.format("")), None),
        (model_of(POLE + HAND.format(LINK)), None),
        (
            model_of(POLE + HAND.format(""), '<equality><weld body1="hand" body2="pole"/></equality>'),
            "weld of 'pole' and 'hand' ties",
        ),
        (
            model_of(
                POLE + HAND.format('<site name="grip"/>'),
                '<equality><connect name="c" site1="grip" site2="tip"/></equality>',
            ),
            "connect 'c' ties",
        ),
        (
            model_of(
                POLE + HAND.format('<site name="grip"/>'),
                '<tendon><spatial name="rope"><site site="tip"/><site site="grip"/></spatial></tendon>',
            ),
            "machine hangs on it",
        ),
        (model_of(DRONE + HAND.format('<geom size=".1"/>')), "'drone' may touch it"),
        (model_of(DRONE + HAND.format('<body><geom size=".1"/></body>')), "'drone' may touch it"),
        (model_of(HAND.format(POLE)), "machine hangs on it"),
        (
            model_of(
                POLE.replace("<geom", '<geom name="rod"') + HAND.format(LINK.replace("<geom", '<geom name="wall"')),
                '<contact><pair geom1="rod" geom2="wall"/></contact>',
            ),
            "'pole' may touch it",
        ),
    ],
)
def test_a_mocap_body_that_something_hangs_on_is_said_to_stand_still(xml: str, said: str | None) -> None:
    found = mocap_bodies(compiled(xml))
    assert [f.where for f in found] == ["'hand'"] * (said is not None)
    assert all(said in f.message and "stand still" in f.message for f in found)


def test_a_complete_trace_tells_of_a_mocap_body_and_not_of_its_soft_weld() -> None:
    xml = PENDULUM.replace("</worldbody>", HAND.format("") + "</worldbody>").replace(
        "</mujoco>", '<equality><weld body1="hand" body2="pole"/></equality></mujoco>'
    )
    model = compiled(xml)
    assert FindingKind.MOCAP_BODY in [f.kind for f in check_against(model, recorded())]
    assert soft_ties(model) == []
    assert len(soft_ties(compiled(xml.replace(' mocap="true"', "")))) == 1


def ball_log() -> Measurements:
    """An arm at a ball joint of three times the model's damping, 0.2 mrad of noise on the quaternions."""
    model, tables = compiled(model_of(ARM.format(0.15), acting(BALL_MOTORS))), {}
    model.opt.timestep = 5e-4
    for run in range(5):
        rng, data, t = np.random.default_rng(run), mujoco.MjData(model), np.arange(200) / 100
        told, rows = 1.2 * rng.uniform(-1, 1, (9, 3))[(t / 0.25).astype(int)], []
        for now in told:
            rows.append(data.qpos.copy())
            data.ctrl[:] = now
            mujoco.mj_step(model, data, 20)
        q = np.array(rows) + 2e-4 * rng.standard_normal((len(t), 4))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        named = {f"qpos.sh.{i}": q[:, i] for i in range(4)} | {f"ctrl.m{a}": told[:, i] for i, a in enumerate("xyz")}
        tables[f"run{run}"] = {"time": t, **named}
    return Measurements.from_tables(tables)


@pytest.mark.slow
def test_a_ball_joint_of_other_damping_is_named_and_no_mass() -> None:
    report = briefly(model_of(ARM.format(0.05), acting(BALL_MOTORS)), ball_log(), [], ["payload"])
    assert report.verdict in ("unexplained", "partly explained")
    kinds = [f.kind for f in report.findings]
    assert FindingKind.BEYOND_THE_LIBRARY in kinds
    assert not {
        FindingKind.UNDECLARED_MASS,
        FindingKind.UNDECLARED_INERTIA,
        FindingKind.EXCHANGED,
        FindingKind.REVERSED,
        FindingKind.EARLY_RESPONSE,
    } & {*kinds}
    (said,) = [f.message for f in report.findings if f.kind == FindingKind.BEYOND_THE_LIBRARY]
    assert "ball joint 'sh'" in said


@pytest.mark.slow
def test_a_pole_that_a_mocap_body_holds_in_the_model_alone_is_unexplained_by_that_body() -> None:
    nominal = PENDULUM.replace("</worldbody>", HAND.format("") + "</worldbody>").replace(
        "</mujoco>", '<equality><weld body1="hand" body2="pole" solref=".05 1"/></equality></mujoco>'
    )
    report = briefly(nominal, recorded(), ["hinge.damping"], ["coulomb_friction"])
    assert report.verdict == "unexplained"
    kinds = [f.kind for f in report.findings]
    assert {FindingKind.MOCAP_BODY, FindingKind.BEYOND_THE_LIBRARY} <= {*kinds}
    assert not {
        FindingKind.SOFT_TIE,
        FindingKind.LARGE_ANGLE,
        FindingKind.UNDECLARED_MASS,
        FindingKind.UNDECLARED_INERTIA,
        FindingKind.REVERSED,
        FindingKind.EARLY_RESPONSE,
    } & {*kinds}
