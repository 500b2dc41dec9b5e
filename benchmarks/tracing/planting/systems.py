"""Planar machines as plain NumPy equations of motion, each with the MJCF of the same rigid bodies.

A machine is a chain of thin rods, by itself or hanging from a cart. With theta the absolute angles of the rods,

    M(q) qdd + c(q, qd) = tau + g(q) - D qd

where the part of M for theta is a_ij cos(theta_i - theta_j), that of c is sum_j a_ij sin(theta_i - theta_j) omega_j^2,
and that of g is b_i (gx cos theta_i + gy sin theta_i), with (gx, gy) gravity in the plane; a and b are sums of masses
and lengths. All hangs down at angle zero (points along -y in the horizontal plane).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

GRAVITY = 9.81
TIMESTEP = 0.002
ROD_RADIUS = 0.02


@dataclass(frozen=True)
class Link:
    """A body and the joint that carries it: a uniform thin rod on a hinge, or a cart on a slide.

    :param body: its name
    :param joint: its joint's name
    :param mass: in kg
    :param length: of the rod in m; 0 for a cart
    :param damping: viscous, in N·m·s or N·s/m
    :param torque: peak of the motor in N·m or N; for a joint without one, a torque that matters at it
    :param motor: name of the motor, None for a passive joint
    :param armature: inertia added to the joint's own diagonal of M, in kg·m² or kg
    """

    body: str
    joint: str
    mass: float
    length: float
    damping: float
    torque: float
    motor: str | None = None
    armature: float = 0.0

    @property
    def hinge(self) -> bool:
        """Whether the joint turns."""
        return self.length > 0


@dataclass(frozen=True)
class System:
    """A machine: a chain of n links, of which only the first may be a cart. Its arrays are (E, n), for E states.

    :param name: of the machine
    :param links: from the base outwards
    :param declared_bodies: those whose mass is declared uncertain
    :param vertical: whether the machine moves in the vertical plane (x, z) rather than in the horizontal one (x, y)
    :param tilt: angle in rad by which gravity is turned: g (sin tilt, 0, -cos tilt)
    :param payload: point mass at the end of the last link, in kg
    """

    name: str
    links: tuple[Link, ...]
    declared_bodies: tuple[str, ...]
    vertical: bool = True
    tilt: float = 0.0
    payload: float = 0.0

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names."""
        return tuple(link.joint for link in self.links)

    @property
    def motors(self) -> tuple[str, ...]:
        """Motor names, in the order of their joints."""
        return tuple(link.motor for link in self.links if link.motor)

    @cached_property
    def driven(self) -> list[int]:
        """Indices of the joints that have a motor."""
        return [i for i, link in enumerate(self.links) if link.motor]

    @cached_property
    def peak(self) -> np.ndarray:
        """Peak torque of each joint's motor in N·m or N, shape (n,); zero at a passive joint."""
        return np.array([link.torque if link.motor else 0.0 for link in self.links])

    @cached_property
    def damping(self) -> np.ndarray:
        """Viscous damping of each joint, shape (n,)."""
        return np.array([link.damping for link in self.links])

    @property
    def declared(self) -> dict[str, float]:
        """Values of the declared parameters, ``<joint>.damping`` and ``<body>.mass``."""
        damping = {f"{link.joint}.damping": link.damping for link in self.links}
        return damping | {f"{link.body}.mass": link.mass for link in self.links if link.body in self.declared_bodies}

    def with_declared(self, values: Mapping[str, float]) -> "System":
        """The same machine with other values of declared parameters.

        :param values: by name, as in :attr:`declared`
        :raises ValueError: a name that is not declared
        """
        if unknown := sorted(set(values) - set(self.declared)):
            raise ValueError(f"values names {unknown[0]!r}; {self.name} declares {', '.join(self.declared)}")
        links = (
            replace(
                link,
                damping=float(values.get(f"{link.joint}.damping", link.damping)),
                mass=float(values.get(f"{link.body}.mass", link.mass)),
            )
            for link in self.links
        )
        return replace(self, links=tuple(links))

    @cached_property
    def _cart(self) -> int:
        return int(not self.links[0].hinge)

    @cached_property
    def _mass(self) -> float:
        return sum(link.mass for link in self.links) + self.payload

    @cached_property
    def _coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """The a of shape (L, L) and b of shape (L,) of the module's equations, for the L rods."""
        rods = self.links[self._cart :]
        mass, length = np.array([(rod.mass, rod.length) for rod in rods]).T
        beyond = np.array([mass[i + 1 :].sum() for i in range(len(rods))]) + self.payload
        b = (mass / 2 + beyond) * length
        a = np.zeros((len(rods), len(rods)))
        for i in range(len(rods)):
            a[i, i] = (mass[i] / 3 + beyond[i]) * length[i] ** 2
            a[i, i + 1 :] = a[i + 1 :, i] = length[i] * b[i + 1 :]
        return a, b

    @cached_property
    def _absolute(self) -> np.ndarray:
        """The matrix (L, n) that turns joint coordinates into absolute angles."""
        rods = len(self.links) - self._cart
        return np.hstack([np.zeros((rods, self._cart)), np.tril(np.ones((rods, rods)))])

    @cached_property
    def _g(self) -> tuple[float, float]:
        """Gravity within the plane of motion, in m/s²."""
        return GRAVITY * np.sin(self.tilt), -GRAVITY * np.cos(self.tilt) if self.vertical else 0.0

    def terms(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All that depends on the position alone.

        :param q: positions in rad or m, shape (E, n)
        :return: M of shape (E, n, n); C of shape (E, n, L) with c(q, qd) = C omega^2, omega the absolute rates; g of
            shape (E, n)
        """
        a, b = self._coefficients
        absolute = self._absolute
        theta = q @ absolute.T
        sin, cos = np.sin(theta), np.cos(theta)
        across = theta[:, :, None] - theta[:, None, :]
        m = absolute.T @ (a * np.cos(across)) @ absolute
        c = absolute.T @ (a * np.sin(across))
        gx, gy = self._g
        g = (b * (gx * cos + gy * sin)) @ absolute
        if self._cart:
            m[:, 0, 0] = self._mass
            m[:, 0, 1:] = m[:, 1:, 0] = ((b * cos) @ absolute)[:, 1:]
            c[:, 0] = -b * sin
            g[:, 0] = self._mass * gx
        armature = [link.armature for link in self.links]
        m[:, range(len(armature)), range(len(armature))] += armature
        return m, c, g

    def rates(self, qd: np.ndarray) -> np.ndarray:
        """Absolute angular rates omega in rad/s of the L rods, shape (E, L)."""
        return qd @ self._absolute.T

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """M(q), shape (E, n, n), for q of shape (E, n)."""
        return self.terms(q)[0]

    def bias(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Centrifugal and Coriolis forces c(q, qd), shape (E, n)."""
        return np.einsum("enl,el->en", self.terms(q)[1], self.rates(qd) ** 2)

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Generalised force of gravity g(q), shape (E, n)."""
        return self.terms(q)[2]

    def acceleration(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Solve M qdd = tau + g - c - D qd.

        :param tau: generalised force at every joint in N·m or N, shape (E, n)
        :return: shape (E, n)
        """
        force = tau + self.gravity(q) - self.bias(q, qd) - self.damping * qd
        return np.linalg.solve(self.mass_matrix(q), force[..., None])[..., 0]

    def energy(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Kinetic and potential energy in J, shape (E,)."""
        theta = q @ self._absolute.T
        gx, gy = self._g
        fall = (self._coefficients[1] * (gx * np.sin(theta) - gy * np.cos(theta))).sum(-1)
        if self._cart:
            fall = fall + self._mass * gx * q[:, 0]
        return 0.5 * np.einsum("ei,eij,ej->e", qd, self.mass_matrix(q), qd) - fall

    @property
    def xml(self) -> str:
        """MJCF of the same rigid bodies."""
        sky, axis = ("0 0 {}", "0 -1 0") if self.vertical else ("0 {} 0", "0 0 1")
        body = ""
        for i in reversed(range(len(self.links))):
            link = self.links[i]
            joint = f'name="{link.joint}" damping="{link.damping!r}" armature="{link.armature!r}"'
            if link.hinge:
                across, along = link.mass * link.length**2 / 12, link.mass * ROD_RADIUS**2 / 2
                inertia = [across, across, along] if self.vertical else [across, along, across]
                end = sky.format(repr(-link.length))
                middle = sky.format(repr(-link.length / 2))
                joint += f' type="hinge" axis="{axis}"'
                shape = f'type="capsule" fromto="0 0 0 {end}" size="{ROD_RADIUS}"'
                if i == len(self.links) - 1 and self.payload:
                    body = (
                        f'<body name="payload" pos="{end}">'
                        f'<inertial pos="0 0 0" mass="{float(self.payload)!r}" diaginertia="1e-12 1e-12 1e-12"/></body>'
                    )
            else:
                inertia, middle = [0.01, 0.01, 0.01], "0 0 0"
                joint += ' type="slide" axis="1 0 0"'
                shape = 'type="box" size="0.1 0.05 0.05"'
            above = self.links[i - 1].length if i else 0.0
            body = (
                f'<body name="{link.body}" pos="{sky.format(repr(-above))}">\n<joint {joint}/>\n'
                f'<inertial pos="{middle}" mass="{link.mass!r}" diaginertia="{" ".join(map(repr, inertia))}"/>\n'
                f"<geom {shape}/>\n{body}</body>\n"
            )
        motors = "".join(
            f'<motor name="{x.motor}" joint="{x.joint}" gear="1" '
            f'ctrllimited="true" ctrlrange="{-x.torque!r} {x.torque!r}"/>\n'
            for x in self.links
            if x.motor
        )
        down = f"{float(GRAVITY * np.sin(self.tilt))!r} 0 {float(-GRAVITY * np.cos(self.tilt))!r}"
        return (
            f'<mujoco model="{self.name}">\n<compiler angle="radian"/>\n'
            f'<option timestep="{TIMESTEP}" integrator="implicitfast" gravity="{down}">'
            '<flag contact="disable"/></option>\n'
            f"<worldbody>\n{body}</worldbody>\n<actuator>\n{motors}</actuator>\n</mujoco>\n"
        )


SYSTEMS = {
    system.name: system
    for system in (
        System("pendulum", (Link("pole", "hinge", 0.5, 0.6, 0.03, 2.0, "motor"),), ("pole",)),
        System(
            "cartpole",
            (Link("cart", "slide", 1.0, 0.0, 1.0, 6.0, "motor"), Link("pole", "hinge", 0.3, 0.6, 0.01, 0.5)),
            ("pole",),
        ),
        System(
            "double_pendulum",
            (
                Link("upper", "shoulder", 0.5, 0.4, 0.03, 3.0, "shoulder_motor"),
                Link("lower", "elbow", 0.3, 0.4, 0.015, 1.0, "elbow_motor"),
            ),
            ("upper", "lower"),
        ),
        System(
            "reacher",
            (
                Link("upper", "shoulder", 0.4, 0.3, 0.03, 0.6, "shoulder_motor"),
                Link("fore", "elbow", 0.3, 0.3, 0.01, 0.2, "elbow_motor"),
            ),
            ("fore",),  # without gravity, the upper arm's mass would be its motor's armature
            vertical=False,
        ),
        System(
            "arm3",
            (
                Link("upper", "shoulder", 0.8, 0.35, 0.1, 8.0, "shoulder_motor"),
                Link("fore", "elbow", 0.5, 0.3, 0.05, 3.0, "elbow_motor"),
                Link("hand", "wrist", 0.3, 0.2, 0.01, 0.6, "wrist_motor"),
            ),
            ("fore", "hand"),
        ),
    )
}
"""The machines by name; the cart's pole hangs, as all of them do."""
