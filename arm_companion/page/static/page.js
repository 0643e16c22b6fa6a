// Shows what /events sends. Texts go in as text, never as HTML.

import { draw } from "./drawing.js";

const OLD_MS = 2500;
const $ = (id) => document.getElementById(id);
const seen = {};
let setup = {};
let heardAt = -Infinity;
let pressed = null;

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (className) made.className = className;
  return made;
}

function number(value, digits, unit) {
  return typeof value === "number" ? `${value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1")}${unit ? " " + unit : ""}` : "–";
}

const degrees = (value) => (typeof value === "number" ? `${((value * 180) / Math.PI).toFixed(0)}°` : "–");
const words = (name) => name.toLowerCase().replaceAll("_", " ");

function list(id, entries) {
  $(id).replaceChildren(
    ...entries.map(([name, value, bad]) => {
      const box = element("div");
      box.append(element("dt", name), element("dd", value, bad ? "bad" : ""));
      return box;
    }),
  );
}

// A bar of a value with its sigma; from the middle where it may be negative.
function row(name, value, sigma, most, { unit, digits, signed, note, bad }) {
  const box = element("div", undefined, "row");
  const track = element("div", undefined, "track");
  const place = (x) => 100 * Math.min(Math.max(signed ? 0.5 + (0.5 * x) / most : x / most, 0), 1);
  const span = (from, to, className) => {
    const part = element("i", undefined, className);
    const [low, high] = [place(Math.min(from, to)), place(Math.max(from, to))];
    part.style.left = `${low}%`;
    part.style.width = `${high - low}%`;
    return part;
  };
  if (typeof value === "number") {
    track.append(span(0, value, ""));
    if (typeof sigma === "number") track.append(span(value, value + (value < 0 ? -sigma : sigma), "band"));
    if (Math.abs(value) > most) track.classList.add("over");
  }
  if (signed) {
    const middle = element("b");
    middle.style.left = "50%";
    track.append(middle);
  }
  const shown = typeof value === "number" ? `${number(value, digits)} ± ${number(sigma, digits)} ${unit}` : "not known";
  box.append(element("span", name), track, element("span", shown, "number"));
  if (note) box.append(element("small", note, bad ? "bad" : ""));
  return box;
}

const show = {
  setup(data) {
    setup = data;
    $("foot").hidden = !data.abort;
    $("events").replaceChildren(); // what was said lately follows
  },

  limits(data) {
    Object.assign(setup, data);
  },

  state(data) {
    $("state").textContent = data.state;
    $("behaviour").textContent = data.progress === null ? data.behaviour : `${data.behaviour} · ${data.progress} %`;
    $("alarm").hidden = !data.errors.length;
    $("alarm").textContent = data.errors.map(words).join(", ");
    list("bend", [
      ["bend", `${degrees(data.theta)} of ${degrees(data.goal_theta)}`],
      ["direction", degrees(data.delta)],
      ["calibration", data.calibration, data.calibration !== "valid"],
    ]);
    vehicle();
  },

  wrench(data) {
    $("wrench-note").textContent = data.valid ? `as predicted, ${data.source}` : `no prediction, ${data.source}`;
    const axes = ["x", "y", "z"];
    const of = (name, values, sigmas, most, unit, digits) =>
      axes.map((axis, i) => row(`${name} ${axis}`, data.valid ? values[i] : null, sigmas[i], most || 10, { unit, digits, signed: true }));
    $("wrench").replaceChildren(
      ...of("F", data.force, data.force_sigma, setup.force_max, "N", 1),
      ...of("M", data.torque, data.torque_sigma, setup.torque_max, "N m", 2),
    );
  },

  tendons(data) {
    $("tendons").replaceChildren(
      ...data.tension.map((tension, i) => {
        const trouble = data.silent[i] ? "the servo is silent" : data.errors[i] ? `servo error ${data.errors[i]}` : "";
        const note = trouble || `${number(1000 * data.pull[i], 1, "mm")} · ${number(data.temperature[i], 0, "°C")} · ${data.torque[i] ? "torque on" : "limp"}`;
        return row(String(i + 1), data.silent[i] ? null : tension, data.tension_sigma[i], setup.tension_max || 50, { unit: "N", digits: 1, note, bad: trouble !== "" });
      }),
    );
  },

  arm(data) {
    $("arm-note").textContent = !data.backbone.length ? "no solution of the mechanics" : data.held ? "held by the bar" : "";
    draw(data, seen.wrench, setup);
  },

  health: vehicle,

  events(data) {
    const line = element("li", undefined, data.severity);
    line.append(element("time", new Date(1000 * data.time).toLocaleTimeString()), data.text);
    $("events").prepend(line);
    while ($("events").children.length > 50) $("events").lastChild.remove();
  },

  answer(data) {
    if (data.nonce !== pressed) return;
    const progress = data.progress === null ? "" : ` ${data.progress} %`;
    $("answer").textContent = `${data.command}: ${words(data.result)}${progress}${data.reason ? ": " + data.reason : ""}`;
    $("answer").className = ["accepted", "in_progress"].includes(data.result) ? "" : "bad";
  },
};

function vehicle() {
  const { state, health } = seen;
  const entries = [];
  if (state) {
    entries.push(["flight mode", state.vehicle_mode || "–"], ["motors", state.vehicle_armed ? "armed" : "off"]);
  }
  if (health) {
    const age = health.autopilot_age;
    entries.push(["autopilot heard", age === null ? "never" : `${number(age, 1, "s")} ago`, age === null || age > 2]);
    for (const [name, open] of Object.entries(health.links)) entries.push([`link ${name}`, open ? "open" : "closed", !open]);
    entries.push(
      ["supply, least", number(health.voltage_min, 1, "V")],
      ["servo, hottest", number(health.temperature_max, 0, "°C")],
      ["cycles missed", `${health.missed_cycles} of ${health.cycles}`],
      ["cycles failed", String(health.failed_cycles), health.failed_cycles > 0],
    );
  }
  list("health", entries);
}

function link(text, className) {
  $("link").textContent = text;
  $("link").className = `pill ${className}`;
  document.body.classList.toggle("stale", className !== "good");
}

// The stream comes back by itself unless it was refused; then the page is asked for anew, which may ask for the token.
function listen() {
  const source = new EventSource("events");
  for (const topic of Object.keys(show)) {
    source.addEventListener(topic, (event) => {
      const data = JSON.parse(event.data);
      seen[topic] = data;
      if (topic === "state") heardAt = performance.now();
      show[topic](data);
    });
  }
  source.addEventListener("error", async () => {
    link("not connected", "lost");
    if (source.readyState !== EventSource.CLOSED) return;
    const answer = await fetch("page.js", { cache: "no-store" }).catch(() => null);
    if (answer?.status === 401) location.reload();
    else setTimeout(listen, 2000);
  });
}

setInterval(() => {
  const age = performance.now() - heardAt;
  if (age < OLD_MS) link("live", "good");
  else link(Number.isFinite(age) ? `no news for ${(age / 1000).toFixed(0)} s` : "no news yet", "lost");
}, 250);

$("abort").addEventListener("click", async () => {
  const nonce = Array.from(crypto.getRandomValues(new Uint8Array(12)), (x) => x.toString(16).padStart(2, "0")).join("");
  pressed = nonce;
  const say = (text) => {
    $("answer").textContent = text;
    $("answer").className = "bad";
  };
  $("answer").textContent = "ABORT: sending";
  $("answer").className = "";
  try {
    const answer = await fetch("abort", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ nonce }),
      signal: AbortSignal.timeout(3000),
    });
    if (!answer.ok) say(`ABORT was not taken: ${(await answer.text()).trim()}`);
  } catch {
    say("ABORT did not arrive: no connection");
  }
  setTimeout(() => {
    if (pressed === nonce && $("answer").textContent === "ABORT: sending") say("ABORT: sent, and no answer yet");
  }, 3000);
});

listen();
