// The animation of a single body on a canvas: its faces, its path on the sphere, vectors. Drag to rotate, wheel to zoom.
"use strict";
(() => {
  const data = rigidmdData("film-data"), f32 = (text) => rigidmdArray(text, Float32Array);
  const times = rigidmdArray(data.time, Float64Array), q = f32(data.quaternion), place = f32(data.position);
  const path = f32(data.path), when = rigidmdArray(data.when, Float64Array), angles = data.angles && f32(data.angles);
  const vectors = Object.entries(data.vectors).map(([name, one]) => ({ name, color: one.color, values: f32(one.values) }));
  const canvas = document.getElementById("film"), pen = canvas.getContext("2d"), readout = document.getElementById("film-readout");
  let azimuth = data.azimuth, lift = 0.35, zoom = 1, shown = times[0];
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

  function at(time) { // index and share between two samples
    let low = 0, high = times.length - 1;
    while (high - low > 1) { const k = (low + high) >> 1; times[k] <= time ? (low = k) : (high = k); }
    const gap = times[high] - times[low];
    return [low, high, gap > 0 ? (time - times[low]) / gap : 0];
  }
  const between = (array, n, [low, high, share]) =>
    Array.from({ length: n }, (_, k) => (1 - share) * array[n * low + k] + share * array[n * high + k]);
  function rotation(moment) { // the rotation from one sample to the next, at a constant rate
    const [low, high, share] = moment, a = q.slice(4 * low, 4 * low + 4), b = q.slice(4 * high, 4 * high + 4);
    const cos = Math.min(1, a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]), angle = Math.acos(cos);
    const [u, v] = angle < 1e-4 ? [1 - share, share] : [Math.sin((1 - share) * angle) / Math.sin(angle), Math.sin(share * angle) / Math.sin(angle)];
    const raw = [0, 1, 2, 3].map((k) => u * a[k] + v * b[k]), size = Math.hypot(...raw), [w, x, y, z] = raw.map((c) => c / size);
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
  }
  function camera() {
    const [ca, sa, cl, sl] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(lift), Math.sin(lift)];
    return { right: [-sa, ca, 0], up: [-ca * sl, -sa * sl, cl], eye: [ca * cl, sa * cl, sl] };
  }
  const circles = [];
  if (data.sphere) {
    const ring = (point) => Array.from({ length: 73 }, (_, k) => point((k * Math.PI) / 36).map((c) => c * data.sphere));
    for (let k = 1; k < 6; k++) {
      const polar = (k * Math.PI) / 6;
      circles.push(ring((a) => [Math.sin(polar) * Math.cos(a), Math.sin(polar) * Math.sin(a), Math.cos(polar)]));
      circles.push(ring((a) => [Math.cos((k * Math.PI) / 6) * Math.sin(a), Math.sin((k * Math.PI) / 6) * Math.sin(a), Math.cos(a)]));
    }
    circles.push(ring((a) => [Math.sin(a), 0, Math.cos(a)]));
  }

  function show(time) {
    shown = time;
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const half = (0.47 * zoom * Math.min(width, height)), view = camera(), moment = at(time);
    const [ink, faint, cool, warm] = ["ink", "faint", "cool", "warm"].map(color);
    const flat = (p) => [width / 2 + half * dot(p, view.right), height / 2 - half * dot(p, view.up)];
    function curve(points, style, lineWidth, front, back) { // two strokes: what is on the side of the eye, and the rest
      pen.strokeStyle = style;
      pen.lineWidth = lineWidth;
      pen.lineJoin = "round";
      for (const [alpha, side] of [[back, -1], [front, 1]]) {
        if (!alpha) continue;
        pen.globalAlpha = alpha;
        pen.beginPath();
        let open = false;
        for (const p of points) {
          const here = !data.sphere || side * dot(p, view.eye) >= 0, [x, y] = flat(p);
          here ? (open ? pen.lineTo(x, y) : pen.moveTo(x, y)) : 0;
          open = here;
        }
        pen.stroke();
      }
      pen.globalAlpha = 1;
    }
    let count = when.findIndex((t) => t > time);
    if (count < 0) count = when.length;
    const points = (from, to) => Array.from({ length: Math.max(0, to - from) }, (_, k) => path.subarray(3 * (from + k), 3 * (from + k) + 3));
    const Q = rotation(moment), lab = (b) => Q.map((row) => dot(row, b)), origin = between(place, 3, moment);
    const shift = (p) => p.map((c, k) => c + origin[k]), tip = data.sphere ? lab(data.axis).map((c) => c * data.sphere) : origin;
    const gone = [...points(0, count), tip], rest = [tip, ...points(count, when.length)];
    if (data.sphere) {
      const [x, y] = flat([0, 0, 0]), glow = pen.createRadialGradient(x - half * 0.3, y - half * 0.4, 0, x, y, half * data.sphere);
      pen.globalAlpha = 0.16;
      glow.addColorStop(0, color("paper"));
      glow.addColorStop(1, faint);
      pen.fillStyle = glow;
      pen.beginPath();
      pen.arc(x, y, half * data.sphere, 0, 7);
      pen.fill();
      pen.globalAlpha = 1;
      circles.forEach((circle) => curve(circle, faint, 0.6, 0, 0.25));
      curve(rest, cool, 1, 0, 0.1);
      curve(gone, cool, 1.6, 0, 0.3);
    } else {
      curve(rest, cool, 1, 0.3, 0);
      curve(gone, cool, 1.6, 0.95, 0);
    }
    const axes = [[1, 0, 0, "x"], [0, 1, 0, "y"], [0, 0, 1, "z"]], corner = [34, height - 34];
    for (const [a, b, c, name] of axes) {
      const x = corner[0] + 24 * dot([a, b, c], view.right), y = corner[1] - 24 * dot([a, b, c], view.up);
      pen.strokeStyle = pen.fillStyle = faint;
      pen.lineWidth = 1;
      pen.beginPath(); pen.moveTo(...corner); pen.lineTo(x, y); pen.stroke();
      pen.font = "12px system-ui,sans-serif";
      pen.fillText(name, corner[0] + 32 * dot([a, b, c], view.right) - 3, corner[1] - 32 * dot([a, b, c], view.up) + 4);
    }
    const vertices = data.vertices.map((v) => shift(lab(v))), light = [0, 1, 2].map((k) => 0.55 * view.eye[k] + 0.65 * view.up[k] - 0.5 * view.right[k]);
    const faces = data.faces.map((face, k) => {
      const corners = face.map((c) => vertices[c]), middle = [0, 1, 2].map((i) => corners.reduce((s, c) => s + c[i], 0) / corners.length);
      const normal = [0, 0, 0]; // Newell: of any flat polygon
      corners.forEach((c, i) => {
        const d = corners[(i + 1) % corners.length];
        normal[0] += (c[1] - d[1]) * (c[2] + d[2]); normal[1] += (c[2] - d[2]) * (c[0] + d[0]); normal[2] += (c[0] - d[0]) * (c[1] + d[1]);
      });
      const size = Math.hypot(...normal) || 1;
      return { corners, depth: dot(middle, view.eye), normal: normal.map((n) => n / size), painted: data.painted[k] };
    }).filter((face) => dot(face.normal, view.eye) > 0).sort((a, b) => a.depth - b.depth);
    const pivot = data.pinned && flat(origin), centre = shift(lab(data.centre));
    const rod = () => {
      if (!data.pinned) return;
      pen.strokeStyle = ink; pen.lineWidth = 2.5;
      if (data.rod) { pen.beginPath(); pen.moveTo(...pivot); pen.lineTo(...flat(centre)); pen.stroke(); }
      pen.fillStyle = ink; pen.beginPath(); pen.arc(...pivot, 3.5, 0, 7); pen.fill();
    };
    const before = dot(centre, view.eye) > 0;
    if (before) rod();
    for (const face of faces) {
      const tint = 0.62 + 0.38 * Math.max(0, dot(face.normal, light)), [r, g, b] = data.sides[+face.painted].map((c) => Math.round(c * tint));
      pen.fillStyle = pen.strokeStyle = `rgb(${r},${g},${b})`;
      pen.lineWidth = 0.7;
      pen.beginPath();
      face.corners.forEach((c, k) => (k ? pen.lineTo(...flat(c)) : pen.moveTo(...flat(c))));
      pen.closePath(); pen.fill(); pen.stroke();
    }
    if (!before) rod();
    function arrow(from, vector, style, name) {
      const [x, y] = flat(from), [u, v] = flat(from.map((c, k) => c + vector[k])), size = Math.hypot(u - x, v - y);
      if (size < 2) return;
      const [a, b] = [(u - x) / size, (v - y) / size], head = Math.min(11, size);
      pen.strokeStyle = pen.fillStyle = style; pen.lineWidth = 2.2;
      pen.beginPath(); pen.moveTo(x, y); pen.lineTo(u - head * a, v - head * b); pen.stroke();
      pen.beginPath(); pen.moveTo(u, v); pen.lineTo(u - head * a + 4.5 * b, v - head * b - 4.5 * a); pen.lineTo(u - head * a - 4.5 * b, v - head * b + 4.5 * a); pen.fill();
      pen.font = "italic 600 15px system-ui,sans-serif";
      const side = { L: -11, ω: 11 }[name] || 0; // of vectors that lie on one another
      pen.fillText(name, u + 10 * a - 5 - side * b, v + 12 * b + 5 + side * a);
    }
    const from = data.pinned ? origin : centre;
    for (const { name, color: paint, values } of vectors) arrow(from, between(values, 3, moment), color(paint), name);
    if (data.gravity) arrow(centre, data.gravity, ink, "g");
    if (data.sphere) {
      circles.forEach((circle) => curve(circle, faint, 0.6, 0.35, 0));
      curve(rest, cool, 1, 0.3, 0);
      curve(gone, cool, 1.8, 0.95, 0);
      const [x, y] = flat(tip);
      pen.globalAlpha = dot(tip, view.eye) >= 0 ? 1 : 0.4;
      pen.fillStyle = warm; pen.beginPath(); pen.arc(x, y, 4, 0, 7); pen.fill();
      pen.globalAlpha = 1;
    }
    // a scale: a round length
    const length = 10 ** Math.floor(Math.log10(0.5 * data.unit / zoom)), pixels = (half * length) / data.unit;
    pen.strokeStyle = pen.fillStyle = ink; pen.lineWidth = 2;
    pen.beginPath(); pen.moveTo(width - 16 - pixels, height - 14); pen.lineTo(width - 16, height - 14); pen.stroke();
    pen.font = "12px system-ui,sans-serif"; pen.textAlign = "right";
    pen.fillText(`${+length.toPrecision(1)} m`, width - 16, height - 20); pen.textAlign = "left";
    if (angles) {
      const [phi, theta, psi] = [0, 1, 2].map((k) => angles[3 * moment[0] + k]);
      readout.textContent = `φ ${phi.toFixed(1)}°   θ ${theta.toFixed(2)}°   ψ ${psi.toFixed(1)}°`;
    }
  }
  const redraw = () => show(shown), fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); });
  canvas.addEventListener("pointermove", (event) => {
    const old = fingers.get(event.pointerId);
    if (!old) return;
    if (fingers.size === 2) {
      const [other] = [...fingers.values()].filter((f) => f.pointerId !== event.pointerId);
      const far = (f) => Math.hypot(f.clientX - other.clientX, f.clientY - other.clientY);
      zoom = Math.min(50, Math.max(0.2, (zoom * far(event)) / (far(old) || 1)));
    } else {
      azimuth -= (event.clientX - old.clientX) / 150;
      lift = Math.min(1.57, Math.max(-1.57, lift + (event.clientY - old.clientY) / 150));
    }
    fingers.set(event.pointerId, event);
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom = Math.min(50, Math.max(0.2, zoom * Math.exp(-event.deltaY / 500))); redraw(); }, { passive: false });
  canvas.addEventListener("dblclick", () => { azimuth = data.azimuth; lift = 0.35; zoom = 1; redraw(); });
  window.addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme:dark)").addEventListener("change", redraw);
  rigidmdPlayer({ times, unit: "s", length: 15, show });
})();
