"""What the live run and the reading of a log both call: frames and stamps in, events and messages out.

No clock, socket or file in here.  Live and replay differ only in who feeds it: rows close, timers run and decisions fall
by the stamps of the frames, so a recorded flight decides again exactly what was decided in the air.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion import recovery as recoveries
from companion.airframe import Airframe
from companion.align import Aligner, GridRow, Restart
from companion.decision import Action, Facts, Finding, Memory, Policy, decide
from companion.decode import Decoder
from companion.dialect import Fields, Value
from companion.effects import Effect, Judged, Save, Send, Tell
from companion.events import Event, FaultFacts, Json, Kind, Severity
from companion.frames import Frame
from companion.recovery import Evidence, Plan, Recovery, Said, Stage
from companion.statustext import Speaker
from companion.streams import Streams
from companion.vehicle import SILENT_AFTER_US, Heartbeat, LinkState, Watch, heartbeat
from fdi.kernel import Compiler
from fdi.verdict import NO_FAULT, Fault, Monitor, Phase, Verdict

BEAT_US: Final = 1_000_000
FLOWING_US: Final = 3_000_000  # we beat only while rows were judged within so long: a heartbeat must not outlive the work
PARAMETERS_US: Final = 2_000_000  # the vehicle's parameters are asked for again after so long
PARAMETER_TRIES: Final = 10
NEVER_US: Final = 1 << 63
FIRST_COMPONENT: Final = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
LAST_COMPONENT: Final = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER4
DOUBLES: Final = 3  # heartbeats under our ids that we did not send, before we move on
POLICY_PARAMETER: Final = "MFDI_POLICY"
POLICIES: Final = (Policy.OFF, Policy.ADVISE, Policy.AUTO)  # by the parameter's value and the heartbeat's custom_mode
REQUESTS: Final = frozenset(  # by name, what somebody may ask of our own component
    {"TIMESYNC", "COMMAND_LONG", "COMMAND_INT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"}
)
GONE: Final = (LinkState.SILENT, LinkState.LOST)
VETO: Final = mavlink.MAV_CMD_USER_1
CONFIRM: Final = mavlink.MAV_CMD_USER_2

# What a stage of the recovery is called in the events, and how loudly it is said.
STAGE_EVENTS: Final[Mapping[Stage, tuple[str, Severity]]] = {
    Stage.READING: ("considered", Severity.WARNING),
    Stage.SETTING: ("requested", Severity.WARNING),
    Stage.VERIFYING: ("acknowledged", Severity.NOTICE),
    Stage.UNDOING: ("failed", Severity.ERROR),
    Stage.DONE: ("verified", Severity.WARNING),
    Stage.REFUSED: ("refused", Severity.ERROR),
    Stage.ROLLED_BACK: ("rolled_back", Severity.ERROR),
    Stage.UNCERTAIN: ("uncertain", Severity.EMERGENCY),
}
STAGE_SPOKEN: Final[Mapping[Stage, str]] = {
    Stage.SETTING: "{text}",
    Stage.VERIFYING: "changed, watching whether it helps",
    Stage.UNDOING: "putting the parameters back",
    Stage.DONE: "repair verified",
    Stage.REFUSED: "repair refused, parameters as before",
    Stage.ROLLED_BACK: "repair undone, parameters as before",
    Stage.UNCERTAIN: "PARAMETERS UNCERTAIN: CHECK OUTPUTS",
}


@dataclass(slots=True)
class Core:
    """One vehicle's monitor, decisions and recoveries.

    policy: how far it may go by itself.  sysid: listen to this system only.  record: what a killed run left (text of
    `Save`), to be put back.  Feed it with `frame` and `tick`; arrival stamps must not run backwards.
    """

    airframe: Airframe
    policy: Policy
    pinned_sysid: int | None = None
    record: str = ""
    compid: int = FIRST_COMPONENT
    pinned_compid: bool = False
    compiler: Compiler | None = None  # for the monitor, where a whole log is waiting
    counts: Counter[str] = field(default_factory=Counter)
    watch: Watch = field(init=False)
    aligner: Aligner = field(init=False)
    decoder: Decoder = field(init=False)
    monitor: Monitor = field(init=False)
    recovery: Recovery | None = None
    plan: Plan | None = None
    parameters: dict[str, float] = field(default_factory=dict)  # of the vehicle, as far as the judgement depends on them
    standing: Finding = field(default_factory=lambda: Finding(Phase.WARMING))  # the alarm that stands
    faults: list[FaultFacts] = field(default_factory=list)  # everything isolated so far
    _streams: Streams = field(init=False)
    _speaker: Speaker = field(default_factory=Speaker)
    _memory: Memory = field(default_factory=Memory)
    _confirmed: bool = False
    _advised: str = ""
    _now_us: int = 0  # arrival stamp in hand
    _session_us: int = 0  # time of the timers: counts rows, so it never runs back
    _next_beat_us: int = 0
    _rows_us: int | None = None  # arrival stamp at the last row
    _parameters_due_us: int = 0
    _parameter_tries: int = 0
    _doubles: int = 0
    _rivals_told: bool = False
    _missing_told: tuple[str, ...] = ()
    _repeat_us: int = 0
    _row_t_us: int | None = None  # vehicle time of the row in hand: what follows from a row happened then

    def __post_init__(self) -> None:
        config = self.airframe.configuration
        channels = self.airframe.detector.channels
        self.watch = Watch(self.pinned_sysid)
        self.decoder = Decoder(channels)
        self.aligner = Aligner(config.grid.period_us, config.grid.maximal_age_us(channels))
        self.monitor = self.airframe.monitor(compiler=self.compiler)
        self._streams = Streams(config.streams)

    @property
    def sysid(self) -> int:
        """Our system id: the vehicle's; before one is known the one asked for, else 1."""
        return self.watch.sysid or self.pinned_sysid or 1

    # -- in ---------------------------------------------------------------------------------------------------------

    def frame(self, frame: Frame, arrival_us: int) -> list[Effect]:
        """One frame that arrived at this stamp (`tick` with the same stamp is included)."""
        out = self.tick(arrival_us)
        message = frame.definition
        if message is None:
            self.counts["unknown"] += 1
            return out
        name = message.name
        if name == "HEARTBEAT":
            self._heartbeat(heartbeat(frame), out)
        if frame.compid == self.compid and frame.sysid == self.sysid:
            return out
        watch = self.watch
        if frame.compid != watch.compid or frame.sysid != watch.sysid:
            if frame.sysid != self.sysid:
                self.counts["foreign"] += 1
            if name in REQUESTS:
                self._request(frame, out)
            return out
        self.counts["messages"] += 1
        self._streams.heard(name)
        watch.heard_us = arrival_us
        if watch.link in GONE:
            watch.link = LinkState.UP
            self._tell(out, Event(Kind.LINK, "up", Severity.NOTICE, "the vehicle is heard again"), "link is back")
            out += self._streams.ask(arrival_us)
        sampled = self.decoder.decode(frame)
        if sampled is not None:
            for row in self.aligner.push(sampled, arrival_us):
                self._row(row, out)
        if name in REQUESTS:
            self._request(frame, out)
        elif name == "PARAM_VALUE":
            self._parameter(frame.fields(), out)
        elif name == "PARAM_ERROR":
            self._parameter_error(frame.fields(), out)
        return out

    def tick(self, arrival_us: int) -> list[Effect]:
        """Let time pass up to this arrival stamp.  However often it is called, the outcome is the same."""
        out: list[Effect] = []
        self._now_us = arrival_us
        watch = self.watch
        # Called for every frame, and nearly always there is nothing to do: what is rare is asked here, before any call.
        if arrival_us >= self.aligner.due_us:
            for row in self.aligner.due(arrival_us):
                self._row(row, out)
        if arrival_us - watch.heard_us > SILENT_AFTER_US:
            self._silence(arrival_us, out)
        if watch.sysid is None:
            self._choose(arrival_us, out)
        if watch.sysid is not None:
            if arrival_us >= self._parameters_due_us:
                out += self._ask_parameters(arrival_us)
            for send in self._streams.tick(arrival_us):
                out.append(self._to_vehicle(send))
            if self._streams.missing != self._missing_told:
                self._missing_told = self._streams.missing
                self._lacking(out)
        if arrival_us >= self._next_beat_us:
            self._next_beat_us = arrival_us + BEAT_US
            out.append(self._beat(arrival_us))
        if texts := self._speaker.tick(arrival_us):
            self._speak(out, texts)
        return out

    def farewell(self, arrival_us: int) -> list[Effect]:
        """The run ends: one last heartbeat, which also tells the replay of the log up to when we have listened."""
        return [*self.tick(arrival_us), self._heartbeat_of_ours(mavlink.MAV_STATE_POWEROFF)]

    # -- the vehicle ------------------------------------------------------------------------------------------------

    def _silence(self, arrival_us: int, out: list[Effect]) -> None:
        while (change := self.watch.silence(arrival_us)) is not None:
            state, when_us = change
            silent_s = (when_us - self.watch.heard_us) * 1e-6
            text = f"no word from the vehicle for {silent_s:.0f} s"
            self._tell(out, Event(Kind.LINK, state.value, Severity.WARNING, text), at_us=when_us)

    def _choose(self, arrival_us: int, out: list[Effect]) -> None:
        if (ripe_us := self.watch.choose(arrival_us)) is not None:
            self._found(ripe_us, out)
        if self.watch.rivals and not self._rivals_told:
            self._rivals_told = True
            text = f"systems {', '.join(map(str, self.watch.rivals))} all fly; say which one with --sysid"
            self._tell(out, Event(Kind.SELF, "config", Severity.ERROR, text), "several vehicles: give --sysid")

    def _found(self, at_us: int, out: list[Effect]) -> None:
        watch = self.watch
        text = f"system {watch.sysid} component {watch.compid} is the vehicle"
        details = {"autopilot": watch.autopilot, "type": watch.type}
        self._tell(out, Event(Kind.VEHICLE, "seen", Severity.INFO, text, details=details), at_us=at_us)
        spoken = f"watching {self.airframe.name}, policy {self.policy.value}"
        self._tell(out, Event(Kind.LINK, "up", Severity.INFO, "the vehicle is heard"), spoken, at_us=at_us)
        out += [self._to_vehicle(send) for send in self._streams.ask(at_us)]
        if self.record:
            self._take_up_record(out)

    def _take_up_record(self, out: list[Effect]) -> None:
        """A run before this one was killed in the middle of a recovery: put back what it had touched."""
        recovery = recoveries.from_record(self.record)
        self.record = ""
        fault = next((fault for fault in self.airframe.detector.faults if fault.id == recovery.fault_id), None)
        plan = self.airframe.plan(fault) if fault else None
        if plan is None or len(recovery.original) != len(plan.parameters):
            text = f"a recovery of {recovery.fault_id} was under way, and the configuration no longer has it"
            self._tell(out, Event(Kind.RECOVERY, "uncertain", Severity.EMERGENCY, text), STAGE_SPOKEN[Stage.UNCERTAIN])
            return
        self.plan = plan
        self._advance(recovery, recoveries.resume(recovery, plan, self._session_us, "the companion was restarted"), out)

    def _heartbeat(self, beat: Heartbeat, out: list[Effect]) -> None:
        watch = self.watch
        if not watch.known:
            watch.offer(beat, self._now_us)
        if beat.sysid == self.sysid and beat.compid == self.compid:
            self._doubled(out)
        if beat.sysid != watch.sysid or beat.compid != watch.compid:
            return
        if beat.mode != watch.mode and watch.mode is not None:
            self._tell(
                out,
                Event(Kind.VEHICLE, "mode", Severity.INFO, f"mode {beat.mode}", details={"mode": beat.mode}),
            )
        watch.mode = beat.mode
        if beat.armed != watch.armed:
            watch.armed = beat.armed
            name = "armed" if beat.armed else "disarmed"
            self._tell(out, Event(Kind.VEHICLE, name, Severity.NOTICE, f"the vehicle is {name}"))
            if not beat.armed:
                self._landed(out)

    def _landed(self, out: list[Effect]) -> None:
        self.standing = Finding(Phase.WARMING)
        self._advised = ""
        if self.recovery is None or self.plan is None:
            return
        self._advance(self.recovery, recoveries.disarmed(self.recovery, self.plan, self._session_us), out)
        if self.recovery.stage is Stage.DONE:
            names = " and ".join(self.plan.parameters)
            text = f"{names} stay exchanged: mend the cause, then put them back"
            self._tell(
                out, Event(Kind.RECOVERY, "reminder", Severity.WARNING, text), f"{self.plan.parameters[0]} etc. stay swapped"
            )

    def _doubled(self, out: list[Effect]) -> None:
        """Somebody else beats under our ids, as BlueOS and Rpanion do: make way."""
        self._doubles += 1
        if self._doubles < DOUBLES or self.pinned_compid or self.compid >= LAST_COMPONENT:
            return
        self._doubles = 0
        self.compid += 1
        text = f"component {self.compid - 1} is somebody else's, continuing as {self.compid}"
        self._tell(out, Event(Kind.SELF, "config", Severity.NOTICE, text))

    def _lacking(self, out: list[Effect]) -> None:
        for name in self._missing_told:
            event = Event(Kind.CHECK, "stream_missing", Severity.WARNING, f"{name} does not come", details={"message": name})
            self._tell(out, event, f"no {name} stream", at_us=self._streams.until_us)

    def _ask_parameters(self, arrival_us: int) -> list[Effect]:
        if self._parameter_tries >= PARAMETER_TRIES or len(self.parameters) == len(self.airframe.detector.parameters):
            self._parameters_due_us = NEVER_US  # all are known, or never will be: until a reboot
            return []
        missing = [name for name in self.airframe.detector.parameters if name not in self.parameters]
        self._parameters_due_us = arrival_us + PARAMETERS_US
        self._parameter_tries += 1
        return [self._to_vehicle(Send("PARAM_REQUEST_READ", {"param_id": name, "param_index": -1})) for name in missing]

    def _parameter(self, fields: Mapping[str, Value], out: list[Effect]) -> None:
        name, value, kind = str(fields["param_id"]), fields["param_value"], fields["param_type"]
        assert isinstance(value, float)  # as the definition has it
        assert isinstance(kind, int)
        if name in self.airframe.detector.parameters and math.isfinite(value) and self.parameters.get(name) != value:
            self.parameters[name] = value
            self.monitor.told(0, self.parameters)
            self.standing = Finding(Phase.WARMING)  # what was found belongs to the vehicle as it was; judged anew
        if self.recovery is not None and self.plan is not None:
            said = Said(name, value, kind)
            self._advance(self.recovery, recoveries.hear(self.recovery, self.plan, said, self._session_us), out)

    def _parameter_error(self, fields: Mapping[str, Value], out: list[Effect]) -> None:
        code = fields["error"]
        assert isinstance(code, int)
        if self.recovery is not None and self.plan is not None and code:
            name = str(fields["param_id"])
            answer = recoveries.refused_by_vehicle(self.recovery, self.plan, name, code, self._session_us)
            self._advance(self.recovery, answer, out)

    # -- rows -------------------------------------------------------------------------------------------------------

    def _row(self, row: GridRow, out: list[Effect]) -> None:
        self.counts["rows"] += 1
        self._rows_us = self._now_us
        self._row_t_us = row.t_us
        self._session_us += self.airframe.configuration.grid.period_us
        if row.restart is not None:
            self._restart(row, out)
        verdict = self.monitor.step(row.values, row.age_s)
        finding = self._finding(verdict)
        out.append(Judged(row, verdict))
        self._alarm(row, verdict, finding, out)
        self._decide(row, finding, out)
        if self.recovery is not None and self.plan is not None and not self.recovery.ended:
            self._advance(self.recovery, recoveries.tick(self.recovery, self.plan, self._session_us), out)
            evidence = self._evidence(self.plan, verdict, finding)
            self._advance(self.recovery, recoveries.judge(self.recovery, self.plan, evidence, self._session_us), out)
        self._row_t_us = None

    def _restart(self, row: GridRow, out: list[Effect]) -> None:
        self.monitor = self.airframe.monitor(compiler=self.compiler)
        if self.parameters:
            self.monitor.told(0, self.parameters)
        if row.restart is Restart.REBOOT:
            event = Event(Kind.VEHICLE, "reboot", Severity.WARNING, "the autopilot rebooted")
            self._tell(out, event, "autopilot rebooted, watching anew")
            self.parameters.clear()
            self._parameter_tries = self._parameters_due_us = 0
            arrived_us = row.t_us + (self.aligner.offset_us or 0)
            out += [self._to_vehicle(send) for send in self._streams.ask(arrived_us)]
            if self.recovery is not None and self.plan is not None:
                self._advance(self.recovery, recoveries.rebooted(self.recovery, self.plan, self._session_us), out)
        elif row.restart is Restart.JUMP:
            event = Event(Kind.VEHICLE, "clock", Severity.NOTICE, "the vehicle's clock jumped")
            self._tell(out, event)
        if row.restart is not Restart.FIRST and self.recovery is not None and self.recovery.stage is Stage.UNCERTAIN:
            assert self.plan is not None  # there is no recovery without its plan
            again = recoveries.resume(self.recovery, self.plan, self._session_us, "the vehicle is heard again")
            self._advance(self.recovery, again, out)

    def _finding(self, verdict: Verdict) -> Finding:
        fault = int(verdict.fault[0])
        fault_id = self.airframe.detector.faults[fault].id if fault != NO_FAULT else None
        return Finding(Phase(int(verdict.phase[0])), fault_id, float(verdict.confidence[0]))

    def _fault(self, fault_id: str | None) -> Fault | None:
        if fault_id is None:
            return None  # asked at every row
        return next((fault for fault in self.airframe.detector.faults if fault.id == fault_id), None)

    def _alarm(self, row: GridRow, verdict: Verdict, finding: Finding, out: list[Effect]) -> None:
        """Say what has changed since the last row.  A monitor that warms up again neither raises nor clears."""
        before = self.standing
        if finding.phase is Phase.WARMING:
            return
        self.standing = finding
        alarmed = before.phase in (Phase.DETECTED, Phase.ISOLATED, Phase.INCONCLUSIVE)
        if (finding.phase, finding.fault_id) == (before.phase, before.fault_id):
            if finding.phase is Phase.ISOLATED and self._session_us >= self._repeat_us:
                fault = self._fault(finding.fault_id)
                assert fault is not None  # isolated means named
                self._repeat_us = self._session_us + round(1e6 * self.airframe.configuration.decision.repeat_s)
                self._say(out, self._spoken(fault, finding), Severity.CRITICAL)
            return
        evidence = self._residuals(verdict)
        if finding.phase is Phase.HEALTHY:
            if alarmed:
                event = Event(Kind.FAULT, "cleared", Severity.NOTICE, "nothing wrong any more", evidence=evidence)
                self._tell(out, event, "fault cleared")
            return
        if not alarmed:
            over = ", ".join(name for name, (value, limit) in evidence.items() if value > limit) or "a test"
            text = f"something is wrong: {over} above threshold"
            severity = Severity.WARNING
            self._tell(out, Event(Kind.FAULT, "detected", severity, text, evidence=evidence), "something is wrong")
        if finding.phase is Phase.ISOLATED:
            self._isolated(row, verdict, finding, before, out)
        elif finding.phase is Phase.INCONCLUSIVE:
            text = "something is wrong, cause not clear"
            self._tell(out, Event(Kind.FAULT, "inconclusive", Severity.WARNING, text, evidence=evidence), text)

    def _isolated(self, row: GridRow, verdict: Verdict, finding: Finding, before: Finding, out: list[Effect]) -> None:
        fault = self._fault(finding.fault_id)
        assert fault is not None  # isolated means named
        size, age_s = float(verdict.size[0]), float(verdict.onset_s[0])
        facts = FaultFacts(
            fault.id,
            fault.fault_class,
            fault.where,
            finding.confidence,
            size if math.isfinite(size) else None,
            fault.size_unit,
            round(row.t_us / 1e6 - age_s, 6) if math.isfinite(age_s) else None,
        )
        self.faults.append(facts)
        name = "changed" if before.phase is Phase.ISOLATED else "isolated"
        spoken = self._spoken(fault, finding)
        event = Event(Kind.FAULT, name, Severity.CRITICAL, spoken, fault=facts, evidence=self._residuals(verdict))
        self._repeat_us = self._session_us + round(1e6 * self.airframe.configuration.decision.repeat_s)
        self._tell(out, event, spoken)

    @staticmethod
    def _spoken(fault: Fault, finding: Finding) -> str:
        return f"{fault.text} ({100.0 * finding.confidence:.1f} %)"

    def _residuals(self, verdict: Verdict) -> dict[str, tuple[float, float]]:
        return {
            name: (float(verdict.residuals[0, place]), float(verdict.thresholds[place]))
            for place, name in enumerate(self.airframe.detector.residuals)
        }

    def _evidence(self, plan: Plan, verdict: Verdict, finding: Finding) -> Evidence:
        place = self.airframe.detector.residuals.index(plan.verify_residual)
        signal = self.airframe.detector.signals.index(plan.excitation_signal)
        return Evidence(
            judging=finding.phase is not Phase.WARMING,
            alarm=finding.phase in (Phase.DETECTED, Phase.ISOLATED, Phase.INCONCLUSIVE),
            clear=bool(verdict.residuals[0, place] <= verdict.thresholds[place]),  # False for NaN
            excitation=float(verdict.signals[0, signal]),
            period_us=self.airframe.configuration.grid.period_us,
        )

    # -- decisions and recoveries -----------------------------------------------------------------------------------

    def _decide(self, row: GridRow, finding: Finding, out: list[Effect]) -> None:
        fault = self._fault(finding.fault_id)
        plan = self.airframe.plan(fault) if fault else None
        facts = Facts(
            now_us=self._session_us,
            armed=self.watch.armed,
            link_up=self.watch.link is LinkState.UP,
            policy=self.policy,
            mendable=plan is not None,
            busy=self.recovery is not None and not self.recovery.ended,
            confirmed=self._confirmed,
        )
        self._memory, decision = decide(self._memory, finding, facts, self.airframe.configuration.decision)
        if decision.action is Action.RECOVER:
            assert plan is not None  # mendable
            assert finding.fault_id is not None
            self._confirmed = False
            self.plan = plan
            event = Event(Kind.RECOVERY, "considered", Severity.WARNING, plan.text, reason=decision.because)
            self._tell(out, event)
            self.recovery, effects = recoveries.begin(plan, finding.fault_id, self._session_us)
            self._carry_out(effects, out)
        elif decision.action is Action.ADVISE and self.policy is Policy.ADVISE and self._advised != finding.fault_id:
            assert plan is not None
            assert finding.fault_id is not None
            self._advised = finding.fault_id
            event = Event(Kind.RECOVERY, "advised", Severity.WARNING, f"advised: {plan.text}")
            self._tell(out, replace(event, reason=decision.because), f"advise: {plan.text}")

    def _advance(self, before: Recovery, output: recoveries.Output, out: list[Effect]) -> None:
        """Take over the recovery's new state, say what changed, do what it asks."""
        self.recovery, effects = output
        after = self.recovery
        again = before.stage is Stage.UNDO_CHECKING and after.stage is Stage.UNDOING  # another round of the same
        if after.stage is not before.stage and after.stage in STAGE_EVENTS and not again:
            assert self.plan is not None  # there is no recovery without its plan
            name, severity = STAGE_EVENTS[after.stage]
            if name == "failed" and "veto" in after.reason:
                name = "vetoed"
            spoken = STAGE_SPOKEN.get(after.stage, "").format(text=self.plan.text)
            details: dict[str, Json] = {"recovery": {"fault_id": after.fault_id, "stage": after.stage.value}}
            event = Event(Kind.RECOVERY, name, severity, spoken, reason=after.reason, details=details)
            self._tell(out, event, spoken)
        self._carry_out(effects, out)

    def _carry_out(self, effects: Iterable[Send | Save], out: list[Effect]) -> None:
        out.extend(self._to_vehicle(effect) if isinstance(effect, Send) else effect for effect in effects)

    def _to_vehicle(self, send: Send) -> Send:
        """Addressed to the autopilot that is believed."""
        assert self.watch.sysid is not None
        assert self.watch.compid is not None
        target: Fields = {"target_system": self.watch.sysid, "target_component": self.watch.compid}
        return Send(send.message, {**send.fields, **target})

    # -- ourselves --------------------------------------------------------------------------------------------------

    def _request(self, frame: Frame, out: list[Effect]) -> None:
        """What somebody asks of our own component: one of REQUESTS."""
        name, fields = frame.name, frame.fields()
        if name == "TIMESYNC":
            if fields["tc1"] == 0:
                out.append(Send("TIMESYNC", {"tc1": max(1, self._now_us * 1000), "ts1": fields["ts1"]}))
        elif self._addressed(fields):
            if name in ("COMMAND_LONG", "COMMAND_INT"):
                self._command(frame, fields, out)
            else:
                self._own_parameter(frame, fields, out)

    def _addressed(self, fields: Mapping[str, Value]) -> bool:
        return fields["target_system"] == self.sysid and fields["target_component"] == self.compid

    def _command(self, frame: Frame, fields: Mapping[str, Value], out: list[Effect]) -> None:
        command = fields["command"]
        result = mavlink.MAV_RESULT_UNSUPPORTED
        if command == VETO:
            result = mavlink.MAV_RESULT_DENIED
            if self.recovery is not None and self.plan is not None:
                answer = recoveries.veto(self.recovery, self.plan, self._session_us)
                if answer[0] is not self.recovery:
                    result = mavlink.MAV_RESULT_ACCEPTED
                    self._advance(self.recovery, answer, out)
        elif command == CONFIRM:
            advised = self._advised != "" and self._advised == self.standing.fault_id
            result = mavlink.MAV_RESULT_ACCEPTED if advised else mavlink.MAV_RESULT_DENIED
            self._confirmed = self._confirmed or advised
        ack: Fields = {
            "command": command,
            "result": result,
            "target_system": frame.sysid,
            "target_component": frame.compid,
        }
        out.append(Send("COMMAND_ACK", ack))

    def _own_parameter(self, frame: Frame, fields: Mapping[str, Value], out: list[Effect]) -> None:
        """The one parameter that we have: the policy."""
        if frame.name != "PARAM_REQUEST_LIST":
            by_index = frame.name == "PARAM_REQUEST_READ" and fields["param_index"] == 0
            if fields["param_id"] != POLICY_PARAMETER and not by_index:
                return
        if frame.name == "PARAM_SET" and fields["param_value"] in (0.0, 1.0, 2.0):
            value = fields["param_value"]
            assert isinstance(value, float)
            policy = POLICIES[int(value)]
            if policy is not self.policy:
                self.policy = policy
                self._tell(out, Event(Kind.SELF, "config", Severity.NOTICE, f"policy is now {policy.value}"))
        answer: Fields = {
            "param_id": POLICY_PARAMETER,
            "param_value": float(POLICIES.index(self.policy)),
            "param_type": mavlink.MAV_PARAM_TYPE_INT32,
            "param_count": 1,
            "param_index": 0,
        }
        out.append(Send("PARAM_VALUE", answer))

    def _beat(self, arrival_us: int) -> Send:
        """A heartbeat while we do our work; else a knock, so that a restarted vehicle learns where we are."""
        flowing = self._rows_us is not None and arrival_us - self._rows_us <= FLOWING_US
        if self.watch.known and not flowing:
            return Send("TIMESYNC", {"tc1": 0, "ts1": max(1, arrival_us * 1000)})
        return self._heartbeat_of_ours(mavlink.MAV_STATE_ACTIVE if flowing else mavlink.MAV_STATE_STANDBY)

    def _heartbeat_of_ours(self, state: int) -> Send:
        fields: Fields = {
            "type": mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
            "autopilot": mavlink.MAV_AUTOPILOT_INVALID,
            "base_mode": 0,
            "custom_mode": POLICIES.index(self.policy),  # a replay of the log learns the policy from it
            "system_status": state,
            "mavlink_version": 3,
        }
        return Send("HEARTBEAT", fields)

    def _tell(self, out: list[Effect], event: Event, spoken: str = "", *, at_us: int | None = None) -> None:
        """Stamp an event and give it out; `spoken` goes out on STATUSTEXT as well."""
        stamp_us = self._now_us if at_us is None else at_us
        t_us = self._row_t_us if self._row_t_us is not None else self.aligner.vehicle_time_us(stamp_us)
        t = t_us / 1e6 if t_us is not None else None
        out.append(Tell(replace(event, t=t, utc_us=stamp_us), spoken))
        if spoken:
            self._say(out, spoken, event.severity)

    def _say(self, out: list[Effect], text: str, severity: Severity) -> None:
        self._speak(out, self._speaker.say(text, severity, self._now_us))

    @staticmethod
    def _speak(out: list[Effect], texts: Iterable[Fields]) -> None:
        out += [Send("STATUSTEXT", fields) for fields in texts]
