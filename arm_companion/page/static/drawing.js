// Two views of the arm in body axes (forward, right, down; metres) as SVG. Down in the body is down in the picture.

const SPACE = "http://www.w3.org/2000/svg";

function shape(name, attributes, text) {
  const made = document.createElementNS(SPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const VIEWS = { side: (p) => -p[0], rear: (p) => p[1] };


// Pixels per metre and the height that is in the middle, the same in both views, so that they compare. In steps, so that
// the picture does not breathe.
function frameOf(points) {
  let [reach, top, bottom] = [0.1, -0.04, 0.04];
  for (const p of points) {
    reach = Math.max(reach, Math.abs(p[0]), Math.abs(p[1]));
    top = Math.min(top, p[2]);
    bottom = Math.max(bottom, p[2]);
  }
  reach = Math.max(reach, (bottom - top) / 2);
  const steps = [0.1, 0.14, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2, 2, 4, 8];
  const step = steps.find((x) => x >= reach) ?? reach;
  return { scale: 82 / step, middle: Math.round((10 * (top + bottom)) / step) * (step / 20) };
}

function drawView(svg, across, arm, wrench, setup, { scale, middle }) {
  const at = (p) => [100 + scale * across(p), 100 + scale * (p[2] - middle)];
  const [, high] = at([0, 0, 0]);
  const path = (points) => points.map((p, i) => `${i ? "L" : "M"}${at(p).map((x) => x.toFixed(1)).join(" ")}`).join("");
  const parts = [];
  const bar = arm.bar;
  if (bar) {
    const [x, y] = at(bar.point);
    const end = [across(bar.axis), bar.axis[2]];
    const length = Math.hypot(...end);
    if (length > 0.3) {
      const [dx, dy] = end.map((e) => (160 * e) / length);
      parts.push(shape("line", { class: "barline", x1: x - dx, y1: y - dy, x2: x + dx, y2: y + dy }));
    } else {
      parts.push(shape("circle", { class: "bar", cx: x, cy: y, r: Math.max(scale * bar.radius, 1.5) }));
    }
  }
  const half = 0.17 * 88; // the airframe is a sign, not to scale
  parts.push(shape("path", { class: "vehicle", d: `M${100 - half} ${high}H${100 + half}m0 0v-4m-9 0h18M${100 - half} ${high}v-4m-9 0h18` }));
  if (setup.mount) parts.push(shape("path", { class: "vehicle", d: path([[0, 0, 0], setup.mount]) }));
  if (arm.backbone.length) {
    const disks = shape("path", { class: "spine", d: path(arm.backbone), opacity: 0.25 });
    disks.style.strokeWidth = Math.max(2 * scale * (setup.disk_radius ?? 0.01), 3);
    parts.push(disks);
    parts.push(shape("path", { class: "spine", d: path(arm.backbone) }));
  }
  const force = wrench?.valid ? wrench.force : null;
  if (force && force.every((f) => f !== null)) {
    const [dx, dy] = [across(force), force[2]].map((f) => (60 * f) / (setup.force_max || 10));
    const length = Math.hypot(dx, dy);
    if (length > 3) {
      const [ux, uy] = [dx / length, dy / length];
      const [x, y] = [100 + dx, high + dy];
      const head = `M${x} ${y}L${x - 7 * ux - 4 * uy} ${y - 7 * uy + 4 * ux}L${x - 7 * ux + 4 * uy} ${y - 7 * uy - 4 * ux}Z`;
      parts.push(shape("path", { class: "force", d: `M100 ${high}L${x - 5 * ux} ${y - 5 * uy}${head}` }));
    }
  }
  parts.push(shape("line", { class: "scale", x1: 10, y1: 192, x2: 10 + 0.1 * scale, y2: 192 }));
  parts.push(shape("text", { class: "label", x: 10, y: 187 }, "10 cm"));
  svg.replaceChildren(...parts);
}

export function draw(arm, wrench, setup) {
  const near = arm.bar && Math.hypot(...arm.bar.point) < 1.5 ? [arm.bar.point] : [];
  const frame = frameOf([...arm.backbone, ...near, setup.mount ?? [0, 0, 0]]);
  for (const [name, across] of Object.entries(VIEWS)) {
    drawView(document.getElementById(name), across, near.length ? arm : { ...arm, bar: null }, wrench, setup, frame);
  }
}
