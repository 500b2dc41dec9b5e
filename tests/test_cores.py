"""Threads and processes are as many as the cores that this process may run on."""

import os

import mujoco

from sb3_rpto.cores import cores
from sb3_rpto.effects.batch import MujocoBatch

MODEL = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>")


def test_cores_are_those_that_the_process_is_bound_to(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {4, 7, 9}, raising=False)
    assert cores() == 3
    assert MujocoBatch(MODEL, 8).engine.nthread == 3
    assert MujocoBatch(MODEL, 8, 1).engine.nthread == 1


def test_where_none_can_be_bound_all_count(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert cores() == 5
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert cores() == 1
