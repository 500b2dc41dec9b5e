import json
import math
from collections import Counter

import mujoco
import numpy as np
import pytest

from benchmarks.runner import read_table
from benchmarks.tracing import run as tracing
from benchmarks.tracing import table as tables
from benchmarks.tracing.design import design, fingerprint
from benchmarks.tracing.own import MACHINES, OWN, UNSEEN
from benchmarks.tracing.planting import KINDS, SYSTEMS, draw, generate, places
from benchmarks.tracing.score import score, share, wilson
from benchmarks.tracing.table import table, write
from benchmarks.tracing.truth import TWINS, as_effect, deviation, make
from sb3_rpto.effects import LIBRARY, Drive, Effect, Simulation, declare
from sb3_rpto.effects.corrected_model_io import correct

CASES = {case.id: case for case in design("full")}


# --- the design -----------------------------------------------------------------------------------------------------


def test_design_has_the_counts_and_is_always_the_same():
    cases = design("full")
    assert cases == design("full")
    assert fingerprint(cases) == fingerprint(design("full")) != fingerprint(cases[1:])
    groups = Counter(case.group for case in cases)
    assert groups == dict(zip(groups, (40, 105, 20, 15, 10, 15, 10)))
    assert len(cases) == 215
    assert len(CASES) == 215, "ids are unique"
    assert len({case.seed for case in cases}) == 215
    noises = Counter(case.noise for case in cases if case.group == "single")
    assert noises == {1e-3: 63, 5e-3: 42}
    single = Counter(case.effects[0] for case in cases if case.group == "single")
    library = [kind for kind, plant in KINDS.items() if plant.library]
    assert {kind for kind, _ in single} == set(library)
    assert all(single[kind, size] >= 2 for kind in library for size in ("small", "large"))
    complete = [case for case in cases if case.group == "complete"]
    assert {case.system for case in complete} == set(SYSTEMS)
    assert {case.noise for case in complete} == {1e-3, 5e-3}
    assert any(c.jitter for c in complete)
    assert any(c.quantum for c in complete)
    assert not all(c.velocity for c in complete)


def test_quick_design_is_a_part_of_the_full_one():
    quick = design("quick")
    assert 18 <= len(quick) <= 24
    assert all(CASES[case.id] == case for case in quick)
    assert {case.group for case in quick} == {case.group for case in CASES.values()}
    with pytest.raises(ValueError, match="scale is 'huge'"):
        design("huge")


def test_every_effect_has_a_place():
    for case in CASES.values():
        if case.planted_by == "numpy":
            assert all(places(SYSTEMS[case.system], kind) for kind, _ in case.effects), case.id
        else:
            written = [(p.machine, p.kind) for p in (UNSEEN if case.group == "not excited" else OWN)]
            assert written.count((case.system, case.effects[0][0])) == 1, case.id


@pytest.mark.parametrize(
    "id",
    [
        "complete-reacher-5mrad-jitter",
        "single-payload-small-double_pendulum-5mrad",
        "not_excited-command_saturation-cartpole-1mrad",
        "not_excited-dc_motor-reacher-1mrad-effects",
        "own_classes-viscous_friction-InvertedDoublePendulum-v5-1mrad-effects",
        "own_classes-actuator_lag-Reacher-v5-5mrad-effects",
    ],
)
def test_cases_can_be_generated_again(id):
    case = CASES[id]
    first, again = (make(case, episodes=3, duration=0.4) for _ in range(2))
    a, b = first.measurements.tables(), again.measurements.tables()
    assert all((a[name] == b[name]).all() for name in a)
    assert first.planted == again.planted
    assert len(first.planted) == len(case.effects)
    assert all(e.label in first.planted for e in first.effects)
    labels = {f"{e.on}.{name}" for e in first.effects for name in e.same}
    assert not labels & set(first.declared), "what an effect changes is not declared"
    step = np.median(np.diff(first.measurements.episodes[0].time))
    assert step == pytest.approx(0.004, rel=0.1)


def test_effects_outside_the_library_have_a_label_and_no_model():
    made = make(CASES["outside-thermal-small-pendulum-1mrad"], episodes=2, duration=0.2)
    assert made.planted == ("thermal(motor)",)
    assert made.effects == ()


def test_a_limit_that_is_not_excited_is_above_all_commands():
    made = make(CASES["not_excited-command_saturation-pendulum-1mrad"], episodes=5, duration=1.0)
    (effect,) = made.effects
    assert 1 / effect.values[0] > np.abs(made.measurements.tables()["ctrl.motor"]).max()


def test_gymnasium_machines_keep_off_their_stops():
    for name in ("InvertedDoublePendulum-v5", "Reacher-v5"):
        case = next(c for c in CASES.values() if c.system == name)
        made = make(case, episodes=5, duration=2.0)
        model = made.model.unwrapped.model
        for joint in MACHINES[name].system.joints:
            low, high = model.joint(joint).range
            q = made.measurements.tables()[f"qpos.{joint}"]
            assert not model.joint(joint).limited[0] or (low < q.min() - 0.02 and q.max() + 0.02 < high)


# --- the truth in the tracer's terms --------------------------------------------------------------------------------


def predict(xml, effects, q, commands, before=0):
    """Positions, (n, steps + 1, nq), from rest."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = 0.0005
    simulation = Simulation(model, effects, 1)
    q = np.atleast_2d(q)
    values = np.tile(simulation.values(), (len(q), 1))
    return simulation.rollout(values, q, np.zeros_like(q), Drive(commands, before))[0]


@pytest.mark.parametrize("kind", [kind for kind, plant in KINDS.items() if plant.library])
def test_library_effects_do_what_the_planted_ones_do(kind):
    """MuJoCo with the translated effect follows the NumPy machine, and without it does not."""
    system = SYSTEMS["double_pendulum"]
    # Where the gain raises a command above the motor's range, MuJoCo clips it and the NumPy machine does not.
    plant = draw(system, kind, "large", 2 if kind == "command_gain" else 3)
    made = generate(system, [plant], 3, episodes=5, duration=0.6, rate=250.0, noise=0.0)
    data, effect = made.measurements.episodes, as_effect(system, plant)
    model = mujoco.MjModel.from_xml_string(made.xml)
    effect.bind(model)
    known = [d.with_values(np.array([made.truth.declared[d.label]])) for d in declare(model, made.declared)]
    commands = np.repeat(np.stack([e.ctrl for e in data]), 8, axis=1)
    commands = np.pad(commands, [(0, 0), (600, 0), (0, 0)])  # the planted chain begins with zeros
    measured = np.stack([e.qpos for e in data])
    error = []
    for effects in ([effect], []):
        q = predict(made.xml, [*known, *effects], made.truth.qpos[:, 0], commands, before=600)[:, :-1:8]
        for e in effects:
            if e.overrides("observe"):
                q[..., e.adr] = e.observe(q[..., e.adr], q[..., e.adr], e.values[None])[0]
            if e.overrides("late"):
                time = 0.004 * np.arange(q.shape[1])
                q[..., e.adr] = [np.interp(time - e.late(e.values), time, series) for series in q[..., e.adr]]
        error.append(np.sqrt(np.mean((q - measured) ** 2)))
    assert error[0] < 0.1 * error[1]


def test_every_effect_of_the_planting_has_a_translation():
    for system in SYSTEMS.values():
        for kind, plant in KINDS.items():
            for j in places(system, kind) if plant.library else ():
                assert isinstance(as_effect(system, plant(j)), Effect)


def twin_values():
    """For each set of twins: machine, and for each of two of them effects, declared values, offset of what is shown."""
    m, length, added, tilt, gain = 0.5, 0.6, 0.06, 0.1, 0.8
    pole = mujoco.MjModel.from_xml_string(SYSTEMS["pendulum"].xml)
    longer = correct(pole, [LIBRARY["link_length"]("pole", change=0.1)])
    (i0, w0), (i1, w1) = map(inertia_and_weight, (pole, longer))
    wet = mujoco.MjData(thick := correct(pole, [LIBRARY["fluid"](density=20.0)]))
    wet.qvel[:] = 1.0
    mujoco.mj_forward(thick, wet)
    lighter = {"pole.mass": m - 2 * added}
    cart = {"slide.damping": 1.0, "hinge.damping": 0.01, "pole.mass": 0.3}
    scaled = {name: value / gain for name, value in cart.items()}
    return {
        "pendulum: payload, armature": (
            "pendulum",
            ([("payload", "pole", {"mass": added, "along": 2.0})], lighter, 0),
            ([("armature", "hinge", {"inertia": added * length**2 / 3})], {}, 0),
        ),
        "pendulum: link_length, armature": (
            "pendulum",
            ([("link_length", "pole", {"change": 0.1})], {}, 0),
            ([("armature", "hinge", {"inertia": i1 - i0 * w1 / w0})], {"pole.mass": m * w1 / w0}, 0),
        ),
        "pendulum: fluid, quadratic_drag": (
            "pendulum",
            ([("fluid", "", {"density": 20.0})], {}, 0),
            ([("quadratic_drag", "hinge", {"coefficient": -wet.qfrc_fluid[0]})], {}, 0),
        ),
        **{
            f"{system}: gravity_tilt, sensor_bias": (
                system,
                ([("gravity_tilt", "", {"y": tilt})], {}, 0),
                ([("sensor_bias", joint, {"offset": -tilt})], {}, -tilt),
            )
            for system, joint in (("pendulum", "hinge"), ("double_pendulum", "shoulder"), ("arm3", "shoulder"))
        },
        "double_pendulum: payload, armature": (
            "double_pendulum",
            ([("payload", "upper", {"mass": added, "along": 2.0})], {"upper.mass": 0.5 - 2 * added}, 0),
            ([("armature", "shoulder", {"inertia": added * 0.4**2 / 3})], {}, 0),
        ),
        "reacher: payload, armature": (
            "reacher",
            ([("payload", "upper", {"mass": added, "along": 2.0})], {}, 0),
            ([("armature", "shoulder", {"inertia": added * 0.3**2})], {}, 0),
        ),
        "cartpole: command_gain, armature": (
            "cartpole",
            ([("command_gain", "motor", {"change": gain - 1})], cart, 0),
            ([("armature", "slide", {"inertia": 1 / gain - 1})], scaled, 0),
        ),
        "cartpole: command_gain, payload": (
            "cartpole",
            ([("command_gain", "motor", {"change": gain - 1})], cart, 0),
            ([("payload", "cart", {"mass": 1 / gain - 1})], scaled, 0),
        ),
    }


def inertia_and_weight(model):
    """Of a pendulum, about its hinge: kg·m², and N·m when it is level."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.pi / 2
    mujoco.mj_forward(model, data)
    return data.M[0], data.qfrc_bias[0]


TWIN_CASES = twin_values()


@pytest.mark.parametrize("name", TWIN_CASES)
def test_twins_move_alike(name):
    system, *both = TWIN_CASES[name]
    machine, rng = SYSTEMS[system], np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-1, 1, (3, 10, len(machine.motors))), 100, axis=1) * machine.peak[machine.driven]
    q = rng.uniform(-1, 1, (3, len(machine.links)))
    model = mujoco.MjModel.from_xml_string(machine.xml)

    def shown(effects, values, offset):
        known = [d.with_values(np.array([values[d.label]])) for d in declare(model, [*values])]
        start = q.copy()
        start[:, 0] -= offset
        moved = predict(machine.xml, [*known, *(LIBRARY[k](on, **v) for k, on, v in effects)], start, commands)
        moved[..., 0] += offset
        return moved

    one, other = (shown(*side) for side in both)
    without = shown([], {}, 0)
    assert np.abs(one - other).max() < 1e-3 * np.abs(one - without).max()
    labels = {LIBRARY[k](on, **v).label for effects, _, _ in both for k, on, v in effects}
    assert any(s == system and labels <= same for s, same, _ in TWINS)


def test_every_twin_is_tested():
    tested = {
        (system, LIBRARY[k](on).label) for system, *both in TWIN_CASES.values() for e, _, _ in both for k, on, _ in e
    }
    assert tested == {(system, label) for system, same, _ in TWINS for label in same}


def test_deviation():
    assert deviation("coulomb_friction", {"level": 2.0}, {"level": 2.5}) == pytest.approx(0.25)
    assert deviation("payload", {"mass": 1.0, "along": 2.0}, {"mass": 0.9, "along": 3.0}) == pytest.approx(0.1)
    true, found = ({"amplitude": 1.0, "phase": phase} for phase in (np.pi - 0.05, -np.pi + 0.05))
    assert deviation("position_friction", true, found) == pytest.approx(0.1, rel=0.01), "a phase goes round"
    assert deviation("gravity_tilt", {"x": 0.0, "y": 0.1}, {"x": 0.3, "y": 0.1}) == 0
    assert deviation(
        "asymmetric_damping", {"forward": 1.0, "backward": 0.0}, {"forward": 1.5, "backward": 0.5}
    ) == pytest.approx(0), "what both have is declared damping"
    fluid = {"density": 10.0, "viscosity": 0.0}
    assert deviation("fluid", fluid, {"density": 12.0, "viscosity": 3.0}) == pytest.approx(0.2)


# --- scores ---------------------------------------------------------------------------------------------------------


def result(id="single-coulomb_friction-small-pendulum-1mrad", named=(), error=None, after=1.0, **changes):
    """A result as it is stored: named is (label, alike, values), with intervals of 20 % to both sides."""
    case = CASES[id]
    effects = [
        {
            "label": label,
            "alike": list(alike),
            "parameters": {k: {"value": v, "low": 0.8 * v, "high": 1.2 * v} for k, v in values.items()},
        }
        for label, alike, values in named
    ]
    made = {
        "case": case.to_json(),
        "version": "0",
        "commit": None,
        "error": error,
        "planted": {"coulomb_friction(hinge)": {"level": 0.1}},
        "verdict": "explained",
        "effects": effects,
        "candidates": {},
        "ratio_before": 3.0,
        "ratio_after": 1.0,
        "errors": {
            name: {"hinge": x} for name, x in (("before", 5.0), ("after", after), ("floor", 1.0), ("true", 1.0))
        },
        "seconds": 60.0,
    }
    return made | changes


def only(made):
    (row,) = score([made])
    return row


RIGHT = ("coulomb_friction(hinge)", (), {"level": 0.11})


def test_zeros_are_told_from_each_other_within_a_quarter_of_their_spread():
    truth, found = {"hinge": [0.03, -0.01, 0.02, -0.04]}, {"0": 0.05, "1": 0.012, "3": -0.021}

    def zeros(offsets):
        told = None if offsets is None else {"offsets": {"hinge": offsets}, "gain": 0.5, "t": 5.0}
        return only(result("run_zeros-pendulum-1mrad", planted={}, zeros=told, true_zeros=truth)).measures["zeros"]

    assert zeros(found)  # 20 mrad more in all of them
    assert not zeros(found | {"3": -0.005})
    assert not zeros(None)


def test_right_answer():
    row = only(result(named=[RIGHT]))
    assert row.passed
    assert all(row.measures.values())
    assert not row.why
    assert row.deviation == pytest.approx(0.1)
    assert row.reduction == pytest.approx(1.0)
    assert not only(result(named=[("coulomb_friction(hinge)", (), {"level": 0.2})])).measures["values"]
    weak = only(result(named=[RIGHT], after=2.0))
    assert weak.reduction == pytest.approx(0.75)
    assert not weak.measures["error reduction"]
    blind = only(result(named=[RIGHT], errors=result()["errors"] | {"true": {"hinge": 4.9}}))
    assert blind.measures["error reduction"] is None, "nothing to take away"


def test_intervals_of_what_is_named_itself_are_to_hold_the_truth():
    def holds(named, **changes):
        return only(result(named=named, **changes)).measures["intervals"]

    assert holds([RIGHT])
    assert not holds([("coulomb_friction(hinge)", (), {"level": 0.13})])
    assert holds([("stribeck_friction(hinge)", ["coulomb_friction(hinge)"], {"level": 0.1})]) is None
    assert holds([("coulomb_friction(hinge)", (), {"level": np.nan})]) is None, "no interval is known"
    two = {"coulomb_friction(hinge)": {"level": 0.1}, "command_delay(motor)": {"delay": 0.01}}
    late = ("command_delay(motor)", (), {"delay": 0.02})
    assert not holds([RIGHT, late], planted=two)
    turned = {"position_friction(hinge)": {"amplitude": 0.1, "phase": 1.0}}
    assert holds([("position_friction(hinge)", (), {"amplitude": 0.2, "phase": 1.0})], planted=turned) is None


def test_another_of_its_class_is_right_and_not_itself():
    row = only(result(named=[("stribeck_friction(hinge)", ["coulomb_friction(hinge)"], {"level": 0.1})]))
    assert row.passed
    assert row.measures["planted named"]
    assert not row.measures["itself"]
    assert row.measures["values"] is None
    assert row.classes == (2,)


def test_a_twin_is_right_on_its_machine_only():
    answer = {"planted": {"payload(pole)": {"mass": 0.1, "along": 2.0}}}
    named = [("armature(hinge)", (), {"inertia": 0.01})]
    assert only(result(named=named, **answer)).passed
    elsewhere = CASES["complete-cartpole-1mrad"].to_json() | {"group": "single"}
    row = only(result(named=named, case=elsewhere, **answer))
    assert not row.passed
    assert row.deviation == math.inf


def test_extra_and_missed():
    extra = only(result(named=[RIGHT, ("spring(hinge)", (), {"stiffness": 1.0})]))
    assert not extra.passed
    assert extra.measures["planted named"]
    assert extra.why == "named spring(hinge); explained"
    missed = only(result(named=[("spring(hinge)", (), {"stiffness": 1.0})]))
    assert not missed.measures["planted named"]
    assert missed.measures["values"] is False
    assert missed.why == "missed coulomb_friction(hinge); named spring(hinge); explained"
    assert only(result()).why == "missed coulomb_friction(hinge); explained"


def test_one_effect_does_not_stand_for_two():
    planted = {"coulomb_friction(hinge)": {"level": 0.1}, "command_delay(motor)": {"delay": 0.01}}
    one = ("coulomb_friction(hinge)", ["command_delay(motor)"], {"level": 0.1})
    id = "pair-coulomb_friction-large-command_delay-large-pendulum-1mrad"
    row = only(result(id, named=[one], planted=planted))
    assert not row.passed
    assert row.why == "missed command_delay(motor); explained"
    two = [("command_delay(motor)", ["coulomb_friction(hinge)"], {"delay": 0.01}), one]
    row = only(result(id, named=two, planted=planted))
    assert row.passed
    assert row.measures["itself"]
    assert row.deviation == pytest.approx(0)


def test_a_failed_case_is_a_miss():
    made = result(error="Traceback ...\nValueError: no", seconds=1.0)
    row = only({k: made[k] for k in ("case", "version", "commit", "error", "seconds")})
    assert row.verdict == "error"
    assert not any(row.measures.values())
    assert row.why == "ValueError: no"


@pytest.mark.parametrize(
    ("verdict", "passed", "says"),
    [("explained", False, False), ("complete", True, False), ("unexplained", True, True)],
)
def test_outside_must_not_be_explained(verdict, passed, says):
    planted = {"thermal(motor)": None}
    row = only(result("outside-thermal-small-pendulum-1mrad", verdict=verdict, planted=planted, named=[RIGHT]))
    assert row.passed == passed
    assert row.measures["says so"] == says
    assert row.deviation is None


def test_complete_and_not_excited():
    row = only(result("complete-pendulum-1mrad", verdict="unexplained", planted={}))
    assert row.passed
    assert row.measures == {"nothing named": True, "says complete": False}
    assert not only(result("complete-pendulum-1mrad", planted={}, named=[RIGHT])).passed
    id, planted = "not_excited-command_saturation-pendulum-1mrad", {"command_saturation(motor)": {"inverse_limit": 0.4}}
    for verdict, status, listed in (
        ("complete", "not needed", True),
        ("unexplained", "not excited", True),
        ("unexplained", "dropped", False),
    ):
        candidates = {"command_saturation(motor)": status}
        row = only(result(id, verdict=verdict, planted=planted, candidates=candidates))
        assert row.passed
        assert row.measures["listed"] is listed


def test_wilson_interval():
    # Values of Newcombe (1998), Statistics in Medicine 17, table I.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0, 0.1611), abs=5e-5)
    assert wilson(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)
    rows = score([result(named=[RIGHT]), result()])
    assert (share(rows, "right class").hits, share(rows, "right class").n) == (1, 2)
    assert share(rows, "nothing named").n == 0


# --- the table ------------------------------------------------------------------------------------------------------


def test_tables(tmp_path, capsys):
    failed = {**result(error="Traceback\nValueError: no | way"), "effects": []}
    results = [result(named=[RIGHT]), result("complete-pendulum-1mrad", planted={}), failed]
    cases = [CASES[r["case"]["id"]] for r in results]
    text = write(tmp_path / "t", results, cases, "python -m benchmarks tracing --scale quick")
    assert text == table(results) == (tmp_path / "t.md").read_text()
    assert "| single effects, 1 mrad: right class | 90% | 1/2 = 50% [9%, 91%] | no |" in text
    assert "ValueError: no \\| way" in text
    found = json.loads((tmp_path / "t.json").read_text())
    assert found["design"] == fingerprint(cases)
    assert (found["cases"], found["done"], found["errors"]) == (3, 3, 1)
    assert found["versions"]["mujoco"]
    assert [row["case"] for row in read_table(tmp_path / "t.csv")] == [case.to_json() for case in cases]
    (tmp_path / "t.md").unlink()
    assert tables.main([str(tmp_path / "t.csv")]) == 0
    assert capsys.readouterr().out == text + "\n", "the table tells all that the report does"
    assert table([]).startswith("# What the tracer finds")


# --- runs -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def traced(monkeypatch):
    """Ids of the cases that a fake tracer was given; it fails on a drag."""
    seen = []

    def examine(case):
        seen.append(case.id)
        if "quadratic_drag" in case.id:
            raise ValueError("no such thing")
        made = result(case.id, planted={}, ratio_before=math.nan)
        return {name: made[name] for name in made if name not in ("case", "version", "commit", "error")}

    monkeypatch.setattr(tracing, "examine", examine)
    return seen


def test_a_run_repeats_nothing_that_is_done(traced, tmp_path):
    cases = [case for case in design("quick") if case.group == "single"]
    results = tracing.run(tmp_path, cases, 1)
    ids = [case.id for case in cases]
    assert [r["name"] for r in results] == ids, "in the order of the design, though traced in a mixed one"
    assert sorted(traced) == sorted(ids)
    assert traced != ids
    (failed,) = (r for r in results if r["error"])
    assert "quadratic_drag" in failed["name"]
    assert "no such thing" in failed["error"]
    assert results[0]["rows"][0]["ratio_before"] is None, "strict JSON"
    traced.clear()
    tracing.run(tmp_path, cases, 1)
    assert traced == [failed["name"]]


def test_a_part_that_is_traced_again_leaves_the_rest_in_the_table(traced, tmp_path, capsys):
    common = ["--runs", str(tmp_path), "--scale", "quick", "--workers", "1"]
    assert tracing.main([*common, "--only", "^single"]) == 1, "one of them fails"
    singles = len(traced)
    assert tracing.main([*common, "--only", "^complete"]) == 0
    assert f"{len(traced) - 1} of {len(traced) - 1} generated sets traced" in capsys.readouterr().out
    assert len(read_table(tmp_path / "table.csv")) == len(traced) - 1 > singles


def test_command(traced, tmp_path, capsys):
    arguments = ["--runs", str(tmp_path), "--scale", "quick", "--workers", "1", "--only", "^complete-pendulum-1mrad$"]
    assert tracing.main(arguments) == 0
    assert "1 of 1 generated sets traced" in capsys.readouterr().out
    assert tracing.main(arguments) == 0
    assert len(traced) == 1
    assert tracing.main([*arguments, "--fresh"]) == 0
    assert len(traced) == 2
    capsys.readouterr()
    assert json.loads((tmp_path / "table.json").read_text())["command"].startswith("python -m benchmarks tracing")
    assert tracing.main([*arguments, "--list"]) == 0
    assert capsys.readouterr().out == "complete-pendulum-1mrad\n"
    for bad, message in (
        (["--only", "["], "regular"),
        (["--only", "nothing"], "no run"),
        (["--workers", "0"], "workers"),
    ):
        with pytest.raises(ValueError, match=message):
            tracing.main(["--runs", str(tmp_path), *bad])


@pytest.mark.slow
def test_a_small_case_from_end_to_end():
    case = CASES["complete-pendulum-1mrad"]
    found = tracing.examine(case, episodes=8, duration=2.5)
    row = only({"case": case.to_json(), "error": None, **found})
    assert row.passed
    assert row.verdict == "complete"
    assert found["planted"] == {}
    assert found["errors"]["after"]["hinge"] < 2 * found["errors"]["floor"]["hinge"]
    assert found["errors"]["true"] is None


@pytest.mark.slow
def test_the_true_structure_takes_the_error_away(monkeypatch):
    case = CASES["single-coulomb_friction-small-pendulum-1mrad"]

    def few(*arguments, **settings):
        return full(*arguments, candidates=["coulomb_friction"], **settings)

    full = tracing.trace
    monkeypatch.setattr(tracing, "trace", few)
    found = tracing.examine(case, episodes=6, duration=1.5)
    errors = {name: e["hinge"] for name, e in found["errors"].items()}
    assert errors["true"] < 0.5 * errors["before"]
    assert errors["true"] < 1.5 * errors["floor"]
    row = only({"case": case.to_json(), "error": None, **found})
    assert row.passed
    assert row.deviation < 0.25
    assert row.reduction > 0.8
