// The animation of molecules: chemiscope draws a frame, which is unpacked when it is first shown.
"use strict";
(async () => {
  const data = rigidmdData("film-data"), times = [...rigidmdArray(data.time, Float64Array)];
  const packed = rigidmdArray(data.positions, Int16Array), cells = data.cells && rigidmdArray(data.cells, Float32Array);
  const size = data.elements.length, names = data.elements, readout = document.getElementById("film-readout");
  const column = (k, axis) => Array.from({ length: size }, (_, i) => data.low + data.scale * (packed[3 * (k * size + i) + axis] + data.steps));
  const solids = data.solids, orientations = solids && rigidmdArray(solids.orientation, Int16Array), colors = solids && rigidmdArray(solids.color, Uint8Array);
  const solid = (at, semiaxes) => ({
    semiaxes, orientation: [...orientations.subarray(4 * at, 4 * at + 4)].map((x) => x / data.steps),
    color: colors[3 * at] * 65536 + colors[3 * at + 1] * 256 + colors[3 * at + 2],
  });
  const structure = (k) => {
    const found = { size, names, x: column(k, 0), y: column(k, 1), z: column(k, 2), bonds: data.bonds };
    if (solids) found.shapes = { bodies: { kind: "ellipsoid", parameters: { global: {}, atom: solids.semiaxes.map((semiaxes, i) => solid(k * size + i, semiaxes)) } } };
    if (cells) found.cell = [...cells.subarray(9 * k, 9 * k + 9)];
    return found;
  };
  const dataset = {
    meta: { name: data.name },
    structures: times.map((_, k) => ({ size, data: k })),
    properties: { time: { target: "structure", values: times, units: "ps" } },
    settings: { structure: [{ unitCell: !!cells, keepOrientation: true, spaceFilling: false, axes: "off", ...(solids && { shape: "bodies", bonds: false }) }] },
  };
  const config = {
    meta: "film-meta", info: "film-info", structure: "film-picture", maxStructureViewers: 1,
    loadStructure: async (k) => structure(k),
  };
  // Without a graphics card a frame takes a second, as the library draws it at twice the width and height.
  const gl = document.createElement("canvas").getContext("webgl2"), known = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const renderer = known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  if (!gl) throw new Error("this browser has no WebGL 2");
  const coarse = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(renderer);
  if (coarse) Object.defineProperty(window, "devicePixelRatio", { get: () => 0.5 });
  const warnings = new Chemiscope.Warnings();
  warnings.addHandler((message) => { readout.textContent = message; });
  const viewer = await Chemiscope.StructureVisualizer.load(config, dataset, warnings);
  const cell = document.querySelector("#film-picture > div").shadowRoot; // one picture needs no pin, copy and close
  for (const one of cell.querySelectorAll("*")) { // the picture, whose size is in pixels, fills its frame on paper
    if (!one.shadowRoot) continue;
    const style = one.shadowRoot.appendChild(document.createElement("style"));
    style.textContent = "@media print{canvas{width:100%!important;height:100%!important}button{display:none!important}}";
  }
  for (const one of cell.querySelectorAll(".chsp-viewer-action-button")) {
    if (/activ|duplicate|remove|close/i.test(one.textContent + one.innerHTML.slice(0, 200))) one.style.display = "none";
  }
  function frame(time) { // the last one that is not later
    let low = 0, high = times.length;
    while (high - low > 1) { const k = (low + high) >> 1; times[k] <= time * (1 + 1e-12) + 1e-12 ? (low = k) : (high = k); }
    return low;
  }
  let shown = 0;
  await rigidmdPlayer({
    times, unit: "ps", length: 20, begin: data.begin,
    show: async (time) => {
      const k = frame(time);
      if (k === shown) return;
      await viewer.structure.show({ environment: k, structure: k, atom: 0 });
      shown = k;
    },
  });
  window.rigidmd.viewer = viewer;
  window.rigidmd.ready = performance.now();
})().catch((error) => { document.getElementById("film-readout").textContent = `The animation cannot be shown: ${error.message}`; });
