// Sends a photo and shows the answer. Loads nothing from other hosts: map and candidates come from this service.
"use strict";
const $ = (id) => document.getElementById(id);
const value = (id) => $(id).value.trim().replace(",", "."); // decimal commas: 47,5
const FIELDS = ["lat", "lon", "radius_m", "top", "fov", "height", "heading", "pitch"];
const LAID_PX = 1000; // longest side of the photo as it is laid over the map
let photo = null;
let latest = 0; // number of the newest request: answers to older ones are dropped
let shown = null; // the answer on the page
let near = false; // whether the map shows the surroundings of the answer, else all candidates
let pictures = []; // addresses of the pictures on the page

function say(text, kind) {
  $("say").textContent = text;
  $("say").className = kind;
  $("say").scrollIntoView({ block: "nearest" }); // on a phone the answer is below the photo
}

function take(file) {
  if (!file) return;
  photo = file;
  const preview = $("preview");
  if (preview.src) URL.revokeObjectURL(preview.src);
  preview.src = URL.createObjectURL(file);
  preview.hidden = false;
  $("invitation").hidden = true;
  $("name").textContent = `${file.name || "pasted photo"}, ${file.size < 1e6 ? `${Math.ceil(file.size / 1e3)} kB` : `${(file.size / 1e6).toFixed(1)} MB`}`;
  $("ask").disabled = false;
  ask();
}

function authorization() {
  const token = $("token").value.trim();
  return token ? { Authorization: `Bearer ${token}` } : {};
}

async function ask() {
  const number = ++latest;
  const form = new FormData();
  form.append("photo", photo);
  for (const field of FIELDS) if (value(field)) form.append(field, value(field));
  $("answer").hidden = true;
  say("Looking ...", "busy");
  try {
    const response = await fetch("/locate", { method: "POST", body: form, headers: authorization() });
    const body = await response.json();
    if (number !== latest) return;
    if (response.ok) {
      await $("preview").decode().catch(() => {}); // it is laid over the map
      if (number === latest) show(body);
      return;
    }
    if (response.status === 401) {
      $("token-field").hidden = false;
      $("token").focus();
    }
    say(body.error, "error");
  } catch {
    if (number === latest) say("The service does not answer; is it still running? Try again.", "error");
  }
}

function fact(id, text) {
  $(id).textContent = text || "";
  $(id).parentElement.hidden = !text;
}

function show(answer) {
  const { position, probability, candidates, refinement } = answer;
  const place = position && `${position.lat.toFixed(6)}, ${position.lon.toFixed(6)}`;
  say(answer.known ? `Found in ${answer.seconds.toFixed(2)} s.` : "Unknown: no location of the gallery fits well. The best guess:", answer.known ? "soft" : "unknown");
  $("position").textContent = place || (candidates.length ? "No position known" : "No candidate");
  $("copy").hidden = !place;
  $("copy").textContent = "Copy position";
  $("copy").onclick = () => navigator.clipboard.writeText(place).then(() => ($("copy").textContent = "Copied"));
  fact("place", answer.location ?? "none");
  fact("radius", position ? `± ${metres(position.radius_m)}` : "none");
  fact("confidence", probability === null ? "not calibrated" : `${Math.round(100 * probability)} %`);
  $("confidence").className = probability === null ? "" : answer.known ? "sure" : "unknown";
  fact("matches", refinement && `${refinement.inliers} points within ${metres(refinement.residual_m)}`);
  fact("heading-found", refinement && `${Math.round(refinement.heading_deg) % 360}°`);
  fact("camera", refinement && refinement.camera && `${refinement.camera[0].toFixed(6)}, ${refinement.camera[1].toFixed(6)}, ${metres(refinement.camera[2])} up`);
  pictures.forEach((address) => URL.revokeObjectURL(address));
  pictures = [];
  $("candidates").replaceChildren(...candidates.map((candidate, at) => card(candidate, at, answer)));
  $("answer").hidden = false;
  shown = answer;
  near = answer.pictures === "map" && position !== null;
  layPhoto(refinement);
  draw();
}

async function picture(path) {
  const number = latest;
  const response = await fetch(path, { headers: authorization() }).catch(() => null);
  if (!response || !response.ok || number !== latest) return null;
  const address = URL.createObjectURL(await response.blob());
  pictures.push(address);
  return number === latest ? address : null;
}

function card(candidate, at, { position, location, pictures: kind }) {
  const made = (tag, text, name) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (name) element.className = name;
    return element;
  };
  const item = made("li", undefined, candidate.location === location ? "here" : "");
  item.title = candidate.key;
  if (kind !== "none") {
    const image = made("img");
    image.alt = `Candidate ${at + 1}, location ${candidate.location}`;
    picture(`/tile?key=${encodeURIComponent(candidate.key)}`).then((address) => address && (image.src = address));
    item.append(image);
  }
  const line = made("p");
  line.append(made("b", at + 1, "rank"), " ", made("b", candidate.location), " ", made("span", candidate.score.toFixed(3)));
  const away = position && candidate.lat !== null ? metres(distance(position, candidate)) : "";
  const bar = made("span", undefined, "bar");
  bar.append(made("i"));
  bar.firstChild.style.width = `${100 * Math.max(0, Math.min(1, candidate.score))}%`;
  item.append(line, bar, made("small", away && `${away} away`, "away"));
  return item;
}

// The photo, small, on the canvas that lies over the map.
function layPhoto(refinement) {
  const laid = $("laid"), preview = $("preview");
  laid.hidden = $("opacity-field").hidden = $("matches-field").hidden = !refinement;
  if (!refinement) return;
  const scale = Math.min(1, LAID_PX / Math.max(preview.naturalWidth, preview.naturalHeight));
  laid.width = Math.max(1, Math.round(preview.naturalWidth * scale));
  laid.height = Math.max(1, Math.round(preview.naturalHeight * scale));
  laid.getContext("2d").drawImage(preview, 0, 0, laid.width, laid.height);
}

function draw() {
  const stage = $("stage"), wide = stage.clientWidth, high = Math.round(Math.min(480, Math.max(320, 0.75 * wide)));
  const frame = frameOf(shown, wide, high, near);
  stage.hidden = $("controls").hidden = !frame;
  if (!frame) return;
  $("map").setAttribute("viewBox", `0 0 ${wide} ${high}`);
  const rough = { lat: Number(value("lat")), lon: Number(value("lon")), radius_m: Number(value("radius_m")) };
  const { shapes, rule } = marksOf(shown, frame, rough.radius_m > 0 ? rough : null);
  const placed = shown.candidates.filter((candidate) => candidate.lat !== null);
  $("map-title").textContent = `Map of the answer and ${placed.length} candidates with positions; the line is ${metres(rule)}`;
  $("drawn").replaceChildren(...shapes);
  if (shown.refinement) {
    const corners = shown.refinement.footprint.map(([lat, lon]) => frame.place({ lat, lon }));
    $("laid").style.transform = matrix3d($("laid").width, $("laid").height, corners);
  }
  $("extent").hidden = shown.pictures !== "map" || !shown.position || (near && placed.every(frame.shows));
  $("extent").textContent = near ? "Show all candidates" : "Show the answer";
  drawGround(frame);
}

async function drawGround(frame) {
  const ground = $("ground"), side = Math.max(frame.wide, frame.high), number = latest, here = near;
  ground.hidden = true;
  $("stage").classList.remove("over");
  if (shown.pictures !== "map") return;
  const { lat, lon } = frame.centre;
  const address = await picture(`/map?lat=${lat.toFixed(7)}&lon=${lon.toFixed(7)}&half_m=${Math.min(20000, frame.half_m).toFixed(2)}`);
  if (!address || number !== latest || here !== near) return;
  ground.src = address;
  Object.assign(ground.style, { width: `${side}px`, height: `${side}px`, left: `${(frame.wide - side) / 2}px`, top: `${(frame.high - side) / 2}px` });
  ground.hidden = false;
  $("stage").classList.add("over");
}

$("photo").addEventListener("change", (event) => take(event.target.files[0]));
$("form").addEventListener("submit", (event) => {
  event.preventDefault();
  if (photo) ask();
});
$("opacity").addEventListener("input", () => ($("laid").style.opacity = $("opacity").value / 100));
$("with-matches").addEventListener("change", () => $("stage").classList.toggle("plain", !$("with-matches").checked));
$("extent").addEventListener("click", () => {
  near = !near;
  draw();
});
let resized = 0;
addEventListener("resize", () => {
  clearTimeout(resized);
  resized = setTimeout(() => $("answer").hidden || draw(), 150);
});
addEventListener("paste", (event) => take(event.clipboardData.files[0]));
for (const kind of ["dragenter", "dragover", "dragleave", "drop"])
  addEventListener(kind, (event) => {
    event.preventDefault(); // otherwise the browser opens the photo in place of the page
    $("drop").classList.toggle("over", kind === "dragenter" || kind === "dragover");
    if (kind === "drop") take(event.dataTransfer.files[0]);
  });
fetch("/health")
  .then((response) => response.json())
  .then(({ ready, rows, fingerprint, matched, why }) => {
    const known = rows === undefined ? "Ready" : `${rows.toLocaleString("en")} images in the gallery, ${matched ? "photos are matched with the map" : "positions are those of tiles"}, encoder ${fingerprint.slice(0, 12)}`;
    $("index").textContent = ready ? known : `Not ready yet${why ? `: ${why}` : ""}.`;
  })
  .catch(() => ($("index").textContent = "The service does not answer."));
