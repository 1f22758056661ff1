"""Hidden physics: laws as a real machine has them, and in the forms that the usual models give them."""

from benchmarks.hidden_effects.laws.drives import Bias, Deadband, Delay, Gain, Saturation, Transmission
from benchmarks.hidden_effects.laws.friction import (
    PRESLIDING,
    ContactFriction,
    Drag,
    LoadFriction,
    LuGre,
    NativeFriction,
)
from benchmarks.hidden_effects.laws.inertia import Cable, Flywheel, NativeBalance, NativeInertia, Payload, Tilt
from benchmarks.hidden_effects.laws.places import AtDrive, AtJoint
from benchmarks.hidden_effects.laws.sensing import EncoderBias, FrameOffset, Reading
from benchmarks.hidden_effects.laws.springs import Cogging, Coupling, Detent, Spring

__all__ = [
    "PRESLIDING",
    "AtDrive",
    "AtJoint",
    "Bias",
    "Cable",
    "Cogging",
    "ContactFriction",
    "Coupling",
    "Deadband",
    "Delay",
    "Detent",
    "Drag",
    "EncoderBias",
    "Flywheel",
    "FrameOffset",
    "Gain",
    "LoadFriction",
    "LuGre",
    "NativeBalance",
    "NativeFriction",
    "NativeInertia",
    "Payload",
    "Reading",
    "Saturation",
    "Spring",
    "Tilt",
    "Transmission",
]
