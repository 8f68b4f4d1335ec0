// Sends a photo and shows the answer. Loads nothing from other hosts: the map is drawn from the answer's numbers.
"use strict";
const $ = (id) => document.getElementById(id);
const value = (id) => $(id).value.trim().replace(",", "."); // decimal commas: 47,5
const FIELDS = ["lat", "lon", "radius_m", "top"];
let photo = null;
let latest = 0; // number of the newest request: answers to older ones are dropped

function say(text, kind) {
  $("say").textContent = text;
  $("say").className = kind;
  $("say").scrollIntoView({ block: "nearest" }); // on a phone the answer is below the photo
}

function take(file) {
  if (!file) return;
  photo = file;
  const shown = $("preview");
  if (shown.src) URL.revokeObjectURL(shown.src);
  shown.src = URL.createObjectURL(file);
  shown.hidden = false;
  $("invitation").hidden = true;
  $("name").textContent = `${file.name || "pasted photo"}, ${file.size < 1e6 ? `${Math.ceil(file.size / 1e3)} kB` : `${(file.size / 1e6).toFixed(1)} MB`}`;
  $("ask").disabled = false;
  ask();
}

async function ask() {
  const number = ++latest;
  const form = new FormData();
  form.append("photo", photo);
  for (const field of FIELDS) if (value(field)) form.append(field, value(field));
  const token = $("token").value.trim();
  $("answer").hidden = true;
  say("Looking ...", "busy");
  try {
    const response = await fetch("/locate", { method: "POST", body: form, headers: token ? { Authorization: `Bearer ${token}` } : {} });
    const body = await response.json();
    if (number !== latest) return;
    if (response.ok) return show(body);
    if (response.status === 401) {
      $("token-field").hidden = false;
      $("token").focus();
    }
    say(body.error, "error");
  } catch {
    if (number === latest) say("The service does not answer; is it still running? Try again.", "error");
  }
}

function show(answer) {
  const { position, probability, candidates } = answer;
  const place = position && `${position.lat.toFixed(6)}, ${position.lon.toFixed(6)}`;
  say(answer.known ? `Found in ${answer.seconds.toFixed(2)} s.` : "Unknown: no location of the gallery fits well. The best guess:", answer.known ? "soft" : "unknown");
  $("position").textContent = place || (candidates.length ? "No position known" : "No candidate");
  $("copy").hidden = !place;
  $("copy").textContent = "Copy position";
  $("copy").onclick = () => navigator.clipboard.writeText(place).then(() => ($("copy").textContent = "Copied"));
  $("place").textContent = answer.location ?? "none";
  $("radius").textContent = position ? `± ${metres(position.radius_m)}` : "none";
  $("confidence").textContent = probability === null ? "not calibrated" : `${Math.round(100 * probability)} %`;
  $("confidence").className = probability === null ? "" : answer.known ? "sure" : "unknown";
  $("candidates").replaceChildren(...candidates.map((candidate, at) => row(candidate, at, position)));
  $("answer").hidden = false;
  draw(answer);
}

function row(candidate, at, position) {
  const line = document.createElement("tr");
  const cell = (text, name) => {
    const made = document.createElement("td");
    made.textContent = text;
    if (name) made.className = name;
    line.append(made);
    return made;
  };
  cell(at + 1);
  const key = document.createElement("small");
  key.textContent = candidate.key;
  cell(candidate.location, "place").append(key);
  const bar = document.createElement("span");
  bar.className = "bar";
  bar.append(document.createElement("i"));
  bar.firstChild.style.width = `${100 * Math.max(0, Math.min(1, candidate.score))}%`;
  cell(candidate.score.toFixed(3)).append(bar);
  cell(position && candidate.lat !== null ? metres(distance(position, candidate)) : "", "away");
  return line;
}

function metres(length) {
  if (length < 9.95) return `${length.toFixed(1)} m`;
  return length < 9950 ? `${Math.round(length).toLocaleString("en")} m` : `${Math.round(length / 1000).toLocaleString("en")} km`;
}

const PER_DEGREE = 111195; // metres along a meridian
const radians = (degrees) => (degrees * Math.PI) / 180;

function distance(a, b) {
  const h = Math.sin(radians(b.lat - a.lat) / 2) ** 2 + Math.cos(radians(a.lat)) * Math.cos(radians(b.lat)) * Math.sin(radians(b.lon - a.lon) / 2) ** 2;
  return ((2 * 180) / Math.PI) * PER_DEGREE * Math.asin(Math.min(1, Math.sqrt(h)));
}

// The map: metres east and north of the answer, north up; its scale fits all candidates and the circle.
const HIGH = 380, EDGE = 46;
let drawn; // the answer on the map, drawn again when the window is resized

function draw(answer) {
  drawn = answer;
  const { position, candidates, location } = answer;
  const placed = candidates.filter((candidate) => candidate.lat !== null);
  const middle = position || placed[0];
  $("map").toggleAttribute("hidden", !middle);
  if (!middle) return;
  const wide = $("map").parentElement.clientWidth;
  $("map").setAttribute("viewBox", `0 0 ${wide} ${HIGH}`);
  const east = (lon) => ((((lon - middle.lon + 540) % 360) - 180) * Math.cos(radians(middle.lat))) * PER_DEGREE;
  const at = (point) => ({ x: east(point.lon), y: (point.lat - middle.lat) * PER_DEGREE });
  const points = placed.map((candidate) => ({ ...at(candidate), candidate, rank: candidates.indexOf(candidate) + 1 }));
  const reach = Math.max(position ? position.radius_m : 0, 10);
  const xs = [-reach, reach, ...points.map((p) => p.x)], ys = [-reach, reach, ...points.map((p) => p.y)];
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const scale = Math.min((wide - 2 * EDGE) / (right - left), (HIGH - 2 * EDGE) / (high - low)); // pixels per metre
  const to = ({ x, y }) => ({ x: wide / 2 + (x - (left + right) / 2) * scale, y: HIGH / 2 - (y - (low + high) / 2) * scale });
  const shapes = [];
  const rule = nice(110 / scale);
  const origin = to({ x: 0, y: 0 });
  for (let x = origin.x % (rule * scale); x < wide; x += rule * scale) shapes.push(shape("line", { class: "grid", x1: x, x2: x, y1: 0, y2: HIGH }));
  for (let y = origin.y % (rule * scale); y < HIGH; y += rule * scale) shapes.push(shape("line", { class: "grid", x1: 0, x2: wide, y1: y, y2: y }));
  const rough = { lat: Number(value("lat")), lon: Number(value("lon")), radius_m: Number(value("radius_m")) };
  if (rough.radius_m > 0) {
    const centre = to(at(rough));
    shapes.push(shape("circle", { class: "near", cx: centre.x, cy: centre.y, r: rough.radius_m * scale }));
  }
  if (position) shapes.push(shape("circle", { class: "radius", cx: origin.x, cy: origin.y, r: Math.max(11, position.radius_m * scale) }));
  for (const point of points.reverse()) {
    const { x, y } = to(point);
    const dot = shape("circle", { class: point.candidate.location === location ? "dot best" : "dot", cx: x, cy: y, r: 8 });
    dot.append(shape("title", {}, `${point.rank}: ${point.candidate.location}, similarity ${point.candidate.score.toFixed(3)}`));
    shapes.push(dot, shape("text", { class: "rank", x, y: y + 3.5 }, point.rank));
  }
  if (position) shapes.push(shape("path", { class: "here", d: `M${origin.x - 16} ${origin.y}h6m20 0h6M${origin.x} ${origin.y - 16}v6m0 20v6` }));
  shapes.push(shape("line", { class: "rule", x1: 16, x2: 16 + rule * scale, y1: HIGH - 16, y2: HIGH - 16 }));
  shapes.push(shape("text", { x: 16, y: HIGH - 23 }, metres(rule)));
  shapes.push(shape("path", { class: "north", d: `M${wide - 24} 14l6 16-6-4-6 4z` }), shape("text", { x: wide - 28, y: 44 }, "N"));
  $("map-title").textContent = `Map of the answer and ${placed.length} candidates with positions; the line is ${metres(rule)}`;
  $("drawn").replaceChildren(...shapes);
}

function nice(length) {
  const ten = 10 ** Math.floor(Math.log10(length));
  return ten * [5, 2, 1].find((step) => step * ten <= length);
}

function shape(kind, attributes, text) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

$("photo").addEventListener("change", (event) => take(event.target.files[0]));
$("form").addEventListener("submit", (event) => {
  event.preventDefault();
  if (photo) ask();
});
addEventListener("resize", () => $("answer").hidden || draw(drawn));
addEventListener("paste", (event) => take(event.clipboardData.files[0]));
for (const kind of ["dragenter", "dragover", "dragleave", "drop"])
  addEventListener(kind, (event) => {
    event.preventDefault(); // otherwise the browser opens the photo in place of the page
    $("drop").classList.toggle("over", kind === "dragenter" || kind === "dragover");
    if (kind === "drop") take(event.dataTransfer.files[0]);
  });
fetch("/health")
  .then((response) => response.json())
  .then(({ ready, rows, fingerprint, why }) => {
    const known = rows === undefined ? "Ready" : `${rows.toLocaleString("en")} images in the gallery, encoder ${fingerprint.slice(0, 12)}`;
    $("index").textContent = ready ? known : `Not ready yet${why ? `: ${why}` : ""}.`;
  })
  .catch(() => ($("index").textContent = "The service does not answer."));
