// Draws an answer: the map's pixels, the photo laid over them where it belongs, the ellipse, candidates. North is up.
"use strict";
const EDGE = 46; // pixels around the outermost candidate
const NEAR = { refined: 1.2, tile: 4, least: 25 }; // the map around an answer, in reaches of the photo, in radii, in metres
const radians = (degrees) => (degrees * Math.PI) / 180;

// Metres per degree of latitude and of longitude by WGS84, as the service lays the map out.
function perDegree(lat) {
  const e2 = 6.69437999014e-3, bend = 1 - e2 * Math.sin(radians(lat)) ** 2;
  return { lat: radians((6378137 * (1 - e2)) / bend ** 1.5), lon: radians((6378137 / Math.sqrt(bend)) * Math.cos(radians(lat))) };
}

// Metres east and north of a position.
function planeAt(middle) {
  const scale = perDegree(middle.lat);
  return ({ lat, lon }) => ({ x: (((lon - middle.lon + 540) % 360) - 180) * scale.lon, y: (lat - middle.lat) * scale.lat });
}

// The rectangle of ground that a map of this size shows, its scale, and where its points are drawn.
function frameOf(answer, wide, high, near) {
  const { position, candidates, refinement } = answer;
  const middle = position || candidates.find((candidate) => candidate.lat !== null);
  if (!middle) return null;
  const at = planeAt(middle);
  let box;
  if (near) {
    const corners = (refinement ? refinement.footprint : []).map(([lat, lon]) => at({ lat, lon }));
    const reach = Math.max(NEAR.refined * Math.max(0, ...corners.flatMap(({ x, y }) => [Math.abs(x), Math.abs(y)])), refinement ? 0 : NEAR.tile * position.radius_m, NEAR.least);
    box = [-reach, reach, -reach, reach];
  } else {
    const reach = Math.max(position ? position.radius_m : 0, 10);
    const points = candidates.filter((candidate) => candidate.lat !== null).map(at);
    const xs = [-reach, reach, ...points.map((p) => p.x)], ys = [-reach, reach, ...points.map((p) => p.y)];
    box = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  }
  const [left, right, low, high_] = box, edge = near ? 0 : EDGE;
  const scale = Math.min((wide - 2 * edge) / (right - left), (high - 2 * edge) / (high_ - low)); // pixels per metre
  const to = ({ x, y }) => ({ x: wide / 2 + (x - (left + right) / 2) * scale, y: high / 2 - (y - (low + high_) / 2) * scale });
  const perMetre = perDegree(middle.lat);
  const centre = { lat: middle.lat + (low + high_) / 2 / perMetre.lat, lon: middle.lon + (left + right) / 2 / perMetre.lon };
  const place = (point) => to(at(point));
  const shows = (point) => { const { x, y } = place(point); return x >= 0 && x <= wide && y >= 0 && y <= high; };
  return { wide, high, scale, centre, place, shows, half_m: Math.max(wide, high) / 2 / scale };
}

// CSS of the homography that takes a picture of this size to four corners, from its upper left clockwise.
function matrix3d(width, height, corners) {
  const from = [[0, 0], [width, 0], [width, height], [0, height]], rows = [];
  from.forEach(([u, v], i) => {
    const { x, y } = corners[i];
    rows.push([u, v, 1, 0, 0, 0, -u * x, -v * x, x], [0, 0, 0, u, v, 1, -u * y, -v * y, y]);
  });
  for (let pivot = 0; pivot < 8; pivot++) { // Gauss and Jordan, with row pivoting
    const best = rows.slice(pivot).reduce((b, row, i) => (Math.abs(row[pivot]) > Math.abs(rows[b][pivot]) ? pivot + i : b), pivot);
    [rows[pivot], rows[best]] = [rows[best], rows[pivot]];
    rows[pivot] = rows[pivot].map((value) => value / rows[pivot][pivot]);
    rows.forEach((row, i) => { if (i !== pivot) rows[i] = row.map((value, j) => value - row[pivot] * rows[pivot][j]); });
  }
  const [a, b, c, d, e, f, g, h] = rows.map((row) => row[8]);
  return `matrix3d(${[a, d, 0, g, b, e, 0, h, 0, 0, 1, 0, c, f, 0, 1].join(",")})`;
}

// What the answer says, as SVG; `rough` is the circle that was asked for, if any.
function marksOf(answer, frame, rough) {
  const { position, candidates, location, refinement } = answer;
  const { wide, high, scale, place } = frame, shapes = [], rule = nice(110 / scale);
  const origin = place(position || candidates.find((candidate) => candidate.lat !== null));
  for (let x = origin.x % (rule * scale); x < wide; x += rule * scale) shapes.push(shape("line", { class: "grid", x1: x, x2: x, y1: 0, y2: high }));
  for (let y = origin.y % (rule * scale); y < high; y += rule * scale) shapes.push(shape("line", { class: "grid", x1: 0, x2: wide, y1: y, y2: y }));
  if (rough) {
    const centre = place(rough);
    shapes.push(shape("circle", { class: "near", cx: centre.x, cy: centre.y, r: rough.radius_m * scale }));
  }
  if (refinement) {
    const corners = refinement.footprint.map(([lat, lon]) => place({ lat, lon })), text = ({ x, y }) => `${x.toFixed(1)},${y.toFixed(1)}`;
    shapes.push(shape("polygon", { class: "shown", points: corners.map(text).join(" ") }), shape("path", { class: "top", d: `M${text(corners[0])}L${text(corners[1])}` }));
    for (const point of refinement.points) {
      const { x, y } = place(point);
      shapes.push(shape("circle", { class: "match", cx: x, cy: y, r: 3 }));
    }
    if (refinement.camera) {
      const [lat, lon, up] = refinement.camera, { x, y } = place({ lat, lon });
      const dot = shape("circle", { class: "camera", cx: x, cy: y, r: 5 });
      dot.append(shape("title", {}, `the camera, ${metres(up)} above the ground`));
      shapes.push(shape("line", { class: "sight", x1: x, y1: y, x2: origin.x, y2: origin.y }), dot);
    }
  }
  if (position && position.ellipse) {
    const { major_m, minor_m, direction_deg } = position.ellipse;
    const turn = `rotate(${direction_deg - 90} ${origin.x} ${origin.y})`;
    shapes.push(shape("ellipse", { class: "radius", cx: origin.x, cy: origin.y, rx: Math.max(4, major_m * scale), ry: Math.max(4, minor_m * scale), transform: turn }));
  } else if (position) shapes.push(shape("circle", { class: "radius", cx: origin.x, cy: origin.y, r: Math.max(11, position.radius_m * scale) }));
  const dots = candidates.map((candidate, i) => ({ candidate, rank: i + 1 })).filter(({ candidate }) => candidate.lat !== null);
  for (const { candidate, rank } of dots.reverse()) {
    const { x, y } = place(candidate);
    const dot = shape("circle", { class: candidate.location === location ? "dot best" : "dot", cx: x, cy: y, r: 8 });
    dot.append(shape("title", {}, `${rank}: ${candidate.location}, similarity ${candidate.score.toFixed(3)}`));
    shapes.push(dot, shape("text", { class: "rank", x, y: y + 3.5 }, rank));
  }
  if (position) shapes.push(shape("path", { class: "here", d: `M${origin.x - 16} ${origin.y}h10m12 0h10M${origin.x} ${origin.y - 16}v10m0 12v10` }));
  shapes.push(shape("rect", { class: "plate", x: 8, y: high - 40, width: Math.max(rule * scale, 40) + 16, height: 32, rx: 6 }));
  shapes.push(shape("line", { class: "rule", x1: 16, x2: 16 + rule * scale, y1: high - 16, y2: high - 16 }));
  shapes.push(shape("text", { class: "length", x: 16, y: high - 23 }, metres(rule)));
  shapes.push(shape("circle", { class: "plate", cx: wide - 24, cy: 28, r: 20 }), shape("path", { class: "north", d: `M${wide - 24} 12l6 16-6-4-6 4z` }), shape("text", { class: "length", x: wide - 28, y: 42 }, "N"));
  return { shapes, rule };
}

function metres(length) {
  if (length < 0.095) return `${Math.max(1, Math.round(100 * length))} cm`;
  if (length < 9.95) return `${length.toFixed(1)} m`;
  return length < 9950 ? `${Math.round(length).toLocaleString("en")} m` : `${Math.round(length / 1000).toLocaleString("en")} km`;
}

function distance(a, b) {
  const h = Math.sin(radians(b.lat - a.lat) / 2) ** 2 + Math.cos(radians(a.lat)) * Math.cos(radians(b.lat)) * Math.sin(radians(b.lon - a.lon) / 2) ** 2;
  return 2 * 6371008.8 * Math.asin(Math.min(1, Math.sqrt(h)));
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
