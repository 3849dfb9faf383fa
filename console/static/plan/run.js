// Upload to the planner, start, pause, resume and abort; the planner's state in words.

import { post } from "../access.js";
import { refusalOf } from "./check.js";
import { sendMission } from "./header.js";

const $ = (id) => document.getElementById(id);

/** `files.name()` is the name to upload under; returns `{begin(settings), show(state), lost()}`. */
export function createRun(model, files) {
  let settings = { may_upload: false }, mission = null, uploading = false, alive = false, leads = false;

  $("upload").addEventListener("click", async () => {
    uploading = true;
    buttons();
    note("Uploading …");
    try {
      const answer = await post(`api/plan/upload/${encodeURIComponent(files.name())}`, { body: JSON.stringify(model.mission) });
      if (!answer.ok) throw await refusalOf(answer);
      note("The planner has the mission. Arm the machine on its page, then press Start.");
      files.list();
    } catch (error) { note(error.message); }
    uploading = false;
    buttons();
  });
  $("auto").addEventListener("click", () => sendMission("auto"));
  $("pause").addEventListener("click", () => sendMission("pause"));
  $("abort").addEventListener("click", () => { $("end").show(); $("end-no").focus(); });
  $("end-no").addEventListener("click", () => $("end").close());
  $("end-yes").addEventListener("click", () => { $("end").close(); sendMission("abort"); });

  function note(text) { $("run-note").textContent = text; }

  function buttons() {
    const there = Boolean(mission) && alive && !mission.ended, open = there && mission.state !== "WAITING";
    $("upload").disabled = uploading || !leads || !settings.may_upload || !settings.may_plan;
    $("auto").disabled = !open || !leads || mission.auto;
    $("auto").textContent = mission?.driven_m > 0 ? "Resume" : "Start";
    $("pause").disabled = !open || !mission.auto;
    $("abort").disabled = !open || !leads;
    if (!open && $("end").open) $("end").close();
  }

  function show(state) {
    mission = state.mission ?? mission;
    leads = state.lease.mine;
    alive = Boolean(state.mission_alive && state.may_order);
    $("planner").textContent = !state.may_order ? "this page has no planner" : !mission ? "no report from the planner yet"
      : state.mission_alive ? mission.name : "the planner is silent";
    const words = !mission ? "" : mission.failure ? `The mission failed: ${mission.failure}.` : `The machine ${mission.words}.`;
    $("planner-words").textContent = state.mission_alive || mission?.ended ? words : "";
    buttons();
  }

  function command() {
    const folder = settings.folder ? `${settings.folder}/` : "", name = `${folder}${files.name()}`;
    $("command").textContent = `timberhand mission run ${/\s/.test(name) ? `"${name}"` : name}`;
  }
  $("file-name").addEventListener("input", command);

  return {
    begin(told) { settings = told; command(); buttons(); },
    show,
    lost() { alive = false; buttons(); },
  };
}
