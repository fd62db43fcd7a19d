"use strict";
// What is held goes to the session 25 times a second; when nothing arrives for 0.3 s, the robot stands.
const SEND_EVERY = 40, RETRY = 1000, TAKEN_OVER = 4001, DEAD_ZONE = 0.12;
const byId = (id) => document.getElementById(id);
const SLIDERS = ["height", "look", "hand_forward", "hand_aside", "hand_up"];
const NEUTRAL = { height: 0.78, look: 0, hand_forward: 0.3, hand_aside: 0.14, hand_up: 0.15 };
const SLIDER_KEYS = {
  r: ["height", 1], f: ["height", -1], ",": ["look", 1], ".": ["look", -1], t: ["hand_forward", 1],
  g: ["hand_forward", -1], arrowright: ["hand_aside", 1], arrowleft: ["hand_aside", -1], arrowup: ["hand_up", 1],
  arrowdown: ["hand_up", -1],
};
const TRAVEL = 3; // seconds from one end of a slider to the other by key
const EVENT_KEYS = { 1: "kick_left", 2: "kick_right", backspace: "discard_and_reset" };
const SWITCH_KEYS = { 3: "reach_left", 4: "reach_right", 5: "close_left", 6: "close_right", h: "high_steps", c: "sit" };
const PAD_EVENTS = { 0: "kick_right", 2: "kick_left", 8: "discard_and_reset" };
const PAD_SWITCHES = { 1: "sit", 3: "high_steps", 4: "reach_left", 5: "reach_right" };

const keys = new Set();
const pads = { stick: [0, 0], turn: [0, 0] };
const switches = { reach_left: false, reach_right: false, close_left: false, close_right: false, high_steps: false, sit: false };
let values = { ...NEUTRAL };
let ranges = null, camera = "follow", events = [], socket = null, recording = false, lastTick = 0;
let pressed = [], gamepad = null, frames = 30, counted = 0;

const clamp = (x, low = -1, high = 1) => Math.min(Math.max(x, low), high);
const live = (x) => (Math.abs(x) < DEAD_ZONE ? 0 : x);

function connect() {
  socket = new WebSocket(`ws://${location.host}${location.pathname}socket`);
  socket.binaryType = "blob";
  socket.onmessage = ({ data }) => (typeof data === "string" ? take(JSON.parse(data)) : picture(data));
  socket.onclose = ({ code, reason }) => {
    pill("driven", code === TAKEN_OVER ? "another page drives now – reload to take over" : reason || "no connection", "stop");
    if (code !== TAKEN_OVER) setTimeout(connect, RETRY);
  };
}

function picture(blob) {
  const image = byId("picture"), before = image.src;
  image.src = URL.createObjectURL(blob);
  if (before) URL.revokeObjectURL(before);
}

function take(message) {
  if (message.kind === "facts") facts(message);
  else state(message);
}

function facts(f) {
  byId("task").textContent = `${f.task} · ${f.tracker}${f.mode === "base" ? "" : ` · ${f.mode}`}`;
  byId("instruction").textContent = f.instruction;
  document.title = `Drive: ${f.task}`;
  ranges = f.ranges;
  for (const name of SLIDERS) [byId(name).min, byId(name).max] = ranges[name];
  slide();
  byId("world").classList.toggle("bare", !f.frame);
  if (f.frame && byId("frame").src !== f.frame) byId("frame").src = f.frame;
}

function pill(id, text, kind) {
  byId(id).textContent = text;
  byId(id).className = `pill ${kind}`;
}

function state(s) {
  if (s.tick < lastTick) rest();
  lastTick = s.tick;
  recording = s.recording === "recording";
  pill("driven", s.driven ? "you drive" : "nobody drives: the robot stands", s.driven ? "go" : "warn");
  const slow = s.factor < 0.97;
  pill("factor", slow ? `${Math.round(100 * s.factor)} % of real time` : "real time", slow ? "warn" : "");
  pill("clock", `${(Math.max(s.tick, 0) / 50).toFixed(1)} s`, "");
  byId("recording").classList.toggle("recording", recording);
  byId("state").textContent = { idle: "not recorded", recording: "recorded", saved: "saved", discarded: "discarded" }[s.recording];
  byId("note").textContent = s.note;
  const banner = byId("banner");
  const ended = s.outcome && (recording ? `${s.outcome}: save it, or begin again` : `${s.outcome}: begins again`);
  banner.textContent = s.tick < 0 ? "the robot takes its stance" : ended || "";
  banner.className = s.outcome || "";
  banner.hidden = !banner.textContent;
  document.body.dataset.tick = s.tick;
  document.body.dataset.position = s.position.join(" ");
  document.body.dataset.recording = s.recording;
}

function rest() {
  // Another episode: the robot stands, and so does everything that is held.
  values = { ...NEUTRAL };
  for (const name in switches) toggle(name, false);
  slide();
}

function slide() {
  for (const name of SLIDERS) {
    byId(name).value = values[name];
    document.querySelector(`output[for=${name}]`).textContent = values[name].toFixed(2);
  }
}

function toggle(name, on = !switches[name]) {
  switches[name] = on;
  document.querySelector(`[data-switch=${name}]`).classList.toggle("on", on);
}

function ask(event) {
  if (events.length < 8) events.push(event);
}

function press(key) {
  if (key in EVENT_KEYS) ask(EVENT_KEYS[key]);
  if (key in SWITCH_KEYS) toggle(SWITCH_KEYS[key]);
  if (key === " ") ask(recording ? "save_and_reset" : "start");
}

function readGamepad() {
  gamepad = [...(navigator.getGamepads?.() ?? [])].find((g) => g && g.connected) ?? null;
  byId("gamepad").textContent = gamepad ? gamepad.id.split("(")[0].slice(0, 24) : "no gamepad";
  const down = gamepad ? gamepad.buttons.map((b) => b.pressed) : [];
  down.forEach((now, i) => {
    if (!now || pressed[i]) return;
    if (i in PAD_EVENTS) ask(PAD_EVENTS[i]);
    if (i in PAD_SWITCHES) toggle(PAD_SWITCHES[i]);
    if (i === 9) press(" ");
  });
  pressed = down;
}

function drive() {
  const key = (name) => (keys.has(name) ? 1 : 0);
  const slow = key("shift") ? 0.5 : 1;
  const axes = gamepad ? gamepad.axes : [0, 0, 0, 0];
  return {
    forward: clamp(slow * (key("w") - key("s")) - pads.stick[1] - live(axes[1])),
    left: clamp(slow * (key("a") - key("d")) - pads.stick[0] - live(axes[0])),
    turn: clamp(slow * (key("q") - key("e")) - pads.turn[0] - live(axes[2] ?? 0)),
  };
}

function moveSliders() {
  if (!ranges) return;
  const step = (SEND_EVERY / 1000) / TRAVEL;
  const move = (name, sign) => {
    const [low, high] = ranges[name];
    values[name] = clamp(values[name] + sign * step * (high - low), low, high);
  };
  for (const key of keys) if (key in SLIDER_KEYS) move(...SLIDER_KEYS[key]);
  if (pressed[12]) move("height", 1);
  if (pressed[13]) move("height", -1);
  slide();
}

function send() {
  readGamepad();
  moveSliders();
  const d = drive();
  show("stick", "knob", -d.left, -d.forward, 39);
  show("turn", "wheel", -d.turn, 0, 52);
  if (!socket || socket.readyState !== WebSocket.OPEN) return;
  if (socket.bufferedAmount > 0) return; // stale messages help nobody
  const hands = { close_left: switches.close_left || !!pressed[6], close_right: switches.close_right || !!pressed[7] };
  socket.send(JSON.stringify({ ...d, ...values, ...switches, ...hands, camera, frames, events }));
  events = [];
}

function show(pad, knob, x, y, reach) {
  byId(pad).classList.toggle("on", x !== 0 || y !== 0);
  byId(knob).style.transform = `translate(${x * reach}px, ${y * reach}px)`;
}

function letGo() {
  keys.clear();
  pads.stick = [0, 0];
  pads.turn = [0, 0];
}

function pad(id, flat) {
  const element = byId(id);
  const move = (event) => {
    const box = element.getBoundingClientRect();
    const reach = 0.36 * box.width;
    const x = (event.clientX - box.left - box.width / 2) / reach;
    const y = flat ? 0 : (event.clientY - box.top - box.height / 2) / reach;
    const far = Math.max(1, Math.hypot(x, y));
    pads[id] = [x / far, y / far];
  };
  element.onpointerdown = (event) => { element.setPointerCapture(event.pointerId); move(event); };
  element.onpointermove = (event) => { if (element.hasPointerCapture(event.pointerId)) move(event); };
  element.onpointerup = element.onpointercancel = element.onlostpointercapture = () => { pads[id] = [0, 0]; };
}

pad("stick", false);
pad("turn", true);
for (const name of SLIDERS) {
  byId(name).oninput = () => { values[name] = Number(byId(name).value); };
  byId(name).onchange = () => byId(name).blur();
}
for (const button of document.querySelectorAll("button")) {
  button.onclick = () => {
    const { event, switch: name, camera: wanted } = button.dataset;
    if (event) ask(event);
    if (name) toggle(name);
    if (wanted) {
      camera = wanted;
      for (const other of document.querySelectorAll("[data-camera]")) other.classList.toggle("on", other === button);
      byId("shield").hidden = wanted === "free"; // keys go to the world's view while a mouse moves its camera
    }
    button.blur();
  };
}
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase();
  if (!event.repeat) press(key);
  keys.add(key);
  if (key in SLIDER_KEYS || key === " " || key === "backspace") event.preventDefault(); // no scrolling, no going back
});
addEventListener("keyup", (event) => keys.delete(event.key.toLowerCase()));
addEventListener("blur", letGo);
document.addEventListener("visibilitychange", () => { if (document.hidden) letGo(); });
for (const part of [document.querySelector("aside"), document.querySelector("header")]) part.onpointerenter = () => window.focus();
slide();
connect();
setInterval(send, SEND_EVERY);
// A view of the world that is sent faster than it can be drawn falls behind: the session asks how fast that is.
const count = () => { counted++; requestAnimationFrame(count); };
count();
setInterval(() => { frames = clamp(counted, 1, 240); counted = 0; }, 1000);
