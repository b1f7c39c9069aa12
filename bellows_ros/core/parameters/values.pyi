# Made by docs/tools/reference.py; change table.toml and run it again.
from collections.abc import Iterator, Mapping
from typing import Any

class OutputGroup:
    parameters: str
    cell: str
    json: str
    report: str

class ValidationGroup:
    bags: tuple[str, ...]

class LandingGroup:
    height: float

class ReleaseGroup:
    delay: float
    delay_std: float
    tau: float
    tau_std: float
    impulse: float
    impulse_std: float
    blow_off: float
    blow_off_std: float
    closing: float
    closing_std: float
    opening: float
    opening_std: float
    damping: float
    damping_std: float
    sticking: float
    sticking_std: float
    correlation: tuple[float, ...]
    mass_range: tuple[float, ...]

class SafetyGroup:
    least: float

class VacuumGroup:
    signal: str
    attach_below: float
    detach_above: float
    ambient: float
    holding: float

class CoastGroup:
    limit: float
    poses: bool

class AlarmGroup:
    false_per_hour: float

class PayloadGroup:
    estimate: bool

class GripperGroup:
    mass: float
    com: tuple[float, ...]
    inertia: tuple[float, ...]
    std: tuple[float, ...]
    bags: tuple[str, ...]

class WrenchGroup:
    frame: str
    sign: str
    noise: tuple[float, ...]
    drift: tuple[float, ...]
    bias_std: tuple[float, ...]
    gain_std: float
    delay: float

class MeasuredGroup:
    type: str
    rectified: bool
    child_frame: str
    tag_size: float
    tag_id: int
    noise: tuple[float, ...]
    exposure: float
    exposure_std: float
    scale: float
    frame: str
    offset: tuple[float, ...]
    marker_std: tuple[float, ...]
    camera_std: tuple[float, ...]
    latency: float
    latency_std: float

class ToolNoiseGroup:
    position: float
    rotation: float

class FramesGroup:
    package: str
    lip: str
    world: str
    tool: str
    tf: bool

class SteerGroup:
    method: str

class PlanGroup:
    frame: str

class ToolTwistGroup:
    frame: str

class ToolPoseGroup:
    type: str
    offset: str

class GravityGroup:
    magnitude: float
    direction: tuple[float, ...]

class FitGroup:
    method: str
    structure: str
    stretch: str
    relaxation: str
    compare_recordings: bool
    time_offset: bool
    free: tuple[str, ...]

class FilterPackageGroup:
    half_window: int
    order: int

class FilterToolGroup:
    half_window: int
    order: int

class FilterGroup:
    tool: FilterToolGroup
    package: FilterPackageGroup

class EnvelopeGroup:
    deflection_low: tuple[float, ...]
    deflection_high: tuple[float, ...]
    rates: tuple[float, ...]
    frequencies: tuple[float, ...]

class CupGroup:
    length: float
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    relaxation: tuple[float, ...]
    relaxation_times: tuple[float, ...]
    stretch: tuple[float, ...]
    valid_mass: tuple[float, ...]
    valid_vacuum: tuple[float, ...]
    layout: tuple[float, ...]
    open: tuple[float, ...]
    name: str
    length_std: float
    stiffness_std: tuple[float, ...]
    damping_std: tuple[float, ...]
    lip_radius: float
    suction_area: float
    friction: float

class StaticGroup:
    bags: tuple[str, ...]
    files: tuple[str, ...]
    length: bool

class PackageGroup:
    mass: float
    inertia: tuple[float, ...]
    com: tuple[float, ...]
    mass_std: float
    inertia_std: tuple[float, ...]
    com_std: tuple[float, ...]
    size: tuple[float, ...]
    size_center: tuple[float, ...]
    attached: bool
    files: tuple[str, ...]

class RecordingGroup:
    world: str
    package_frame: str
    package_world: str
    align_at_rest: bool
    rest_duration: float
    marker_std: tuple[float, ...]
    marker: str
    clock_std: float
    start: float
    end: float

class TopicsGroup:
    tool_pose: str
    tool_twist: str
    tool_wrench: str
    package_pose: str
    valve: str
    held: str
    pressure: str

class Values(Mapping[str, Any]):
    bags: tuple[str, ...]
    topics: TopicsGroup
    recording: RecordingGroup
    package: PackageGroup
    static: StaticGroup
    cup: CupGroup
    envelope: EnvelopeGroup
    filter: FilterGroup
    fit: FitGroup
    gravity: GravityGroup
    tool_pose: ToolPoseGroup
    tool_twist: ToolTwistGroup
    plan: PlanGroup
    steer: SteerGroup
    tool_link: str
    frames: FramesGroup
    autostart: bool
    tool_noise: ToolNoiseGroup
    measured: MeasuredGroup
    wrench: WrenchGroup
    gripper: GripperGroup
    payload: PayloadGroup
    alarm: AlarmGroup
    coast: CoastGroup
    vacuum: VacuumGroup
    safety: SafetyGroup
    release: ReleaseGroup
    landing: LandingGroup
    validation: ValidationGroup
    output: OutputGroup
    predictor: str
    exit_when_done: bool
    def __init__(self, items: Mapping[str, Any]) -> None: ...
    def __getitem__(self, name: str) -> Any: ...
    def __iter__(self) -> Iterator[str]: ...
    def __len__(self) -> int: ...
    def replaced(self, items: Mapping[str, Any]) -> Values: ...
