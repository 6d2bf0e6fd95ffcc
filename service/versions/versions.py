"""The versions of one service: which decides the next insertion, which run beside it, and when they change places."""

import threading
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

import structlog

from service.contract.frames import Contract, ContractError
from service.contract.wire import ControllerName, Finished, Limits
from service.decision.models import ModelSet, load_models
from service.versions.beside import Beside
from service.versions.contest import ENOUGH, FAILED, Contest, Role
from service.versions.gels import Gels, unlike_gels
from service.versions.store import WIRING, Store, Wiring, check_served, version_of

Publish = Callable[[str, Any], None]
log = structlog.get_logger()


class Version(Contract):
    """One version: its name by its files, that on its card, and what a person should know of it."""

    version: str
    name: str
    cautions: tuple[str, ...]


class Rival(Version):
    """A version beside the active one: ``evidence`` that it should decide, by ``ended_n`` insertions.

    It has foretold ``scored_n`` of their attempts.
    """

    evidence: float
    scored_n: int
    ended_n: int


class State(Contract):
    """Who plays which part; with ``enough`` evidence a version takes over. ``rejected``: why, by version."""

    active: Version
    shadow: Rival | None
    previous: Rival | None
    enough: float = ENOUGH
    rejected: dict[str, str]
    problem: str


class _Now(NamedTuple):
    """The wiring, and every version that it names, loaded and warm. Replaced as a whole, so readers never wait."""

    wiring: Wiring
    networks: dict[str, ModelSet]

    @property
    def active(self) -> ModelSet:
        return self.networks[self.wiring.active]

    def rival(self, role: Role) -> Rival | None:
        """The version in a role beside the active one."""
        if (version := self.wiring.beside.get(role)) is None:
            return None
        contest = self.wiring.contest(role)
        known = self.named(version) | {"scored_n": contest.scored_n, "ended_n": contest.ended_n}
        return Rival(**known, evidence=contest.worth(role))

    def named(self, version: str) -> dict[str, Any]:
        """The fields of `Version`."""
        models = self.networks[version]
        return {"version": version, "name": models.card.name, "cautions": models.cautions}


class Versions:
    """Networks by role. Thread safe; nothing is written before a shadow is given.

    ``publish`` receives each change as an event "version". ``gels``: names of those calibrated. Raises ContractError if
    the active version cannot be loaded unchanged; a failing version beside it is left out.
    """

    def __init__(self, home: Path, released: ModelSet, publish: Publish, gels: Gels | None = None) -> None:
        self.publish, self._gels, self._problem = publish, dict(gels or {}), ""
        self._store, self._lock = Store(home), threading.Lock()
        self._now = _of_release(released)
        try:
            kept = self._store.open()
            if kept is not None and kept.released == self._now.wiring.released:
                self._load(kept)
        except BaseException:
            self._store.close()
            raise

    def _load(self, wiring: Wiring) -> None:
        networks = dict(self._now.networks)
        if wiring.active not in networks:
            try:
                networks[wiring.active] = self._store.load(wiring.active)
            except (ContractError, OSError) as error:
                remedy = f"remove {self._store.home / WIRING} to begin anew with the released networks"
                raise ContractError(f"the version that decides is lost: {error}; {remedy}") from None
        for role, version in wiring.beside.items():
            try:
                networks[version] = networks.get(version) or self._store.load(version)
            except (ContractError, OSError) as error:
                wiring, self._problem = wiring.without(role), f"the {role} version is left out: {error}"
                if version == wiring.given:  # so that the settings give it again
                    wiring = wiring.model_copy(update={"given": ""})
        for version in networks.keys() - self._now.networks:
            _warn(version, networks[version])
        self._now = _Now(wiring, networks)

    def close(self) -> None:
        self._store.close()

    @property
    def active(self) -> ModelSet:
        """The networks that decide the next insertion."""
        return self._now.active

    @property
    def problem(self) -> str:
        """What failed at the start, and what speaks against the active version with these gels."""
        return "; ".join(filter(None, (self._problem, unlike_gels(*self._now, self._gels))))

    def with_hashes(self, networks: Collection[str]) -> ModelSet:
        """The version, released, active or beside, whose deciding files have these SHA-256; else the active one."""
        now = self._now
        wanted = set(networks)
        return next((one for one in now.networks.values() if {e.sha256 for e in one.entries} == wanted), now.active)

    def beside(self, deciding: ModelSet, limits: Limits, controller: ControllerName) -> Beside | None:
        """The versions beside the networks that decide an insertion; None if there are none or they are outdated."""
        wiring, networks = now = self._now
        if not wiring.beside or deciding is not now.active:
            return None
        used = {version: networks[version] for version in (wiring.active, *wiring.beside.values())}
        return Beside(wiring.active, used, limits, controller)

    def state(self) -> State:
        """The active version and those beside it with their evidence."""
        now = self._now
        active = Version(**now.named(now.wiring.active))
        shadow, previous, rejected = now.rival("shadow"), now.rival("previous"), now.wiring.rejected
        return State(active=active, shadow=shadow, previous=previous, rejected=rejected, problem=self.problem)

    # ---- manual changes ----------------------------------------------------------------------------------------------

    def give(self, folder: Path, *, at_start: bool = False) -> None:
        """Let a folder's networks run in shadow, replacing the present shadow.

        Raises ContractError if they cannot serve, cannot be compared, already decide or were rejected, or where the
        served folder has changed; OSError as usual. A setting repeats the request ``at_start`` each time: it is met
        once, so that what a person changes persists; what is refused is a `problem`: a cell works without a shadow.
        """
        try:
            self._give(folder, at_start=at_start)
        except (ContractError, OSError) as error:
            if not at_start:
                raise
            log.warning("no shadow", folder=str(folder), why=str(error))
            if "shadow" not in self._now.wiring.beside:
                self._problem = f"no shadow: {error}"

    def _give(self, folder: Path, *, at_start: bool) -> None:
        models = load_models(folder)
        with self._lock:
            version, wiring = version_of(models), self._now.wiring
            check_served(self._now.networks[wiring.released])
            if version in {wiring.active, *wiring.beside.values()}:
                if not at_start and version != wiring.beside.get("shadow"):
                    raise ContractError(f"{folder} holds version {version}, which decides now, or did before")
                if at_start and version not in {wiring.given, wiring.released}:
                    self._wire(wiring.model_copy(update={"given": version}))
                return
            if why := wiring.rejected.get(version):
                raise ContractError(f"{folder} holds version {version}, which was rejected: {why}")
            if at_start and version == wiring.given:
                return
            if differs := self._now.active.card.incomparable(models.card):
                raise ContractError(f"{folder} cannot run in shadow: {differs[0]}")
            _warn(version, models)
            self._store.keep(self._now.active)
            kept = {**self._now.networks, self._store.keep(models): self._store.load(version)}
            wiring = wiring.with_one("shadow", version, Contest())
            wiring = wiring.model_copy(update={"given": version}) if at_start else wiring
            self._change("shadow", version, f"given as {folder}", wiring, kept)
            self._problem = ""

    def drop(self) -> None:
        """Remove the shadow; raises ContractError if there is none."""
        with self._lock:
            version = self._needed("shadow", "no version runs in shadow")
            self._change("dropped", version, "taken away by hand", self._now.wiring.without("shadow"))

    def promote(self) -> None:
        """Let the shadow decide from the next insertion on; raises ContractError if there is none."""
        with self._lock:
            self._promote("by hand")

    def roll_back(self) -> None:
        """Let the previous version decide from the next insertion on; raises ContractError if there is none."""
        with self._lock:
            self._roll_back("by hand")

    # ---- learning from insertions ------------------------------------------------------------------------------------

    def learn(self, answered: Beside, finished: Finished, of: str, *, fresh: bool, tried_n: int) -> None:
        """Add an ended insertion ``of`` an object, which may show that another version should decide.

        An end that decisions cannot cause is no evidence. ``fresh``: its first attempt was the object's first;
        otherwise ``tried_n`` came before. Raises OSError where nothing can be written.
        """
        with self._lock:
            wiring = self._now.wiring
            inserted = finished.outcome == "inserted"
            if answered.active != wiring.active or not (inserted or answered.blamed(finished)):
                return
            held = answered.went_in() if inserted else {}
            for role, version in wiring.beside.items():
                contest = wiring.contest(role).ended(tried_n + finished.attempts if inserted else FAILED, of)
                compared = fresh and version in answered.networks  # not one that was given meanwhile
                for scores in answered.scores if compared else ():
                    contest = contest.scored(scores[version] - scores[wiring.active])
                if compared and version in held:
                    contest = contest.held(held[version], held[wiring.active])
                wiring = wiring.with_one(role, version, contest)
            self._wire(wiring)
            self._decide(wiring)

    def _wire(self, wiring: Wiring) -> None:
        """Take and store a wiring in which every version keeps its role."""
        self._now = self._now._replace(wiring=wiring)
        self._store.wire(wiring)

    def _decide(self, wiring: Wiring) -> None:
        """Change places as the evidence says; a rollback takes precedence over a promotion."""
        changes: dict[Role, Callable[[str], None]] = {"previous": self._roll_back, "shadow": self._promote}
        for role, change in changes.items():
            contest = wiring.contest(role)
            if role in wiring.beside and contest.worth(role) >= ENOUGH:
                change(f"{contest.because(role)}, {contest.worth(role):.0f} to 1 after {contest.ended_n} insertions")
                return

    def _promote(self, why: str) -> None:
        wiring, version = self._now.wiring, self._needed("shadow", "no version runs in shadow: give one first")
        self._store.keep(self._now.active)
        before = wiring.contest("shadow")
        contest = Contest(tolerated=before.tolerates, tolerated_of=before.tolerates_of)
        wiring = wiring.without("shadow").with_one("previous", wiring.active, contest)
        gels = wiring.gels | {version: self._gels}
        self._change("promoted", version, why, wiring.model_copy(update={"active": version, "gels": gels}))

    def _roll_back(self, why: str) -> None:
        wiring, version = self._now.wiring, self._needed("previous", "there is no version to go back to")
        rejected = wiring.rejected | {wiring.active: why}
        back = wiring.without("previous").model_copy(update={"active": version, "rejected": rejected})
        if shadow := back.beside.get("shadow"):  # its opponent no longer decides
            back = back.with_one("shadow", shadow, Contest())
        kept = f"its networks stay in {self._store.home / wiring.active} until the next rollback"
        self._change("rolled_back", wiring.active, f"{why}; {kept}", back)

    def _needed(self, role: Role, otherwise: str) -> str:
        if role not in self._now.wiring.beside:
            raise ContractError(otherwise)
        return self._now.wiring.beside[role]

    def _change(
        self, what: str, version: str, why: str, wiring: Wiring, networks: dict[str, ModelSet] | None = None
    ) -> None:
        """Store the wiring on disk first, then in memory: an interruption loses only a pending change."""
        self._store.wire(wiring)
        used = {wiring.active, wiring.released, *wiring.beside.values()}
        loaded = (networks or self._now.networks).items()
        self._now = _Now(wiring, {name: one for name, one in loaded if name in used})
        self.publish("version", {"what": what, "version": version, "why": why})


def _of_release(released: ModelSet) -> _Now:
    version = version_of(released)
    _warn(version, released)
    return _Now(Wiring(released=version, active=version), {version: released})


def _warn(version: str, models: ModelSet) -> None:
    for caution in models.cautions:
        log.warning("networks", version=version, caution=caution)
