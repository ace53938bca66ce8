"use strict";
// Points and cameras on a 2D canvas with a depth buffer of our own: no WebGL, so it draws the same everywhere.
(() => {
  const scene = JSON.parse(document.getElementById("scene-data").textContent);
  const canvas = document.getElementById("canvas3d");
  const context = canvas.getContext("2d");
  const byId = (id) => document.getElementById(id);
  const FOV = 50 * Math.PI / 180, FILLED = 0.93, NEAR = 0.02, MOST_PIXELS = 1.6e6, BIGGEST_SPLAT = 24, SHADING = 3;

  function unpack(stage) {
    const bytes = Uint8Array.from(atob(stage.points), (letter) => letter.charCodeAt(0));
    const n = stage.count;
    let at = 0;
    const take = (size) => bytes.subarray(at, at += size * n);
    const found = {
      ...stage, points: null, n,
      xyz: new Float32Array(take(12).slice().buffer), rgb: take(3), rank: take(1), error: take(1), kept: take(1), width: take(1),
    };
    return { ...found, shown: [...found.kept.keys()].filter((i) => found.kept[i]) };
  }
  const stages = Object.fromEntries(scene.stages.map((stage) => [stage.key, unpack(stage)]));

  const colourRamp = (stops) => (share) => {
    const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
    const k = Math.min(Math.floor(place), stops.length - 2), part = place - k;
    return stops[k].map((value, c) => value + part * (stops[k + 1][c] - value));
  };
  const confidenceRamp = colourRamp([[0, 34, 78], [85, 91, 108], [165, 156, 116], [254, 232, 56]]);
  const errorRamp = colourRamp([[20, 11, 53], [132, 32, 107], [229, 92, 48], [252, 255, 164]]);
  const GREY = [128, 128, 128], RED = [226, 46, 46];
  const pack = (c) => 0xff000000 | (c[2] << 16) | (c[1] << 8) | c[0];
  function coloursOf(stage, mode) {
    stage.cache ??= {};
    return stage.cache[mode] ??= Uint32Array.from({ length: stage.n }, (_, i) => {
      if (!stage.kept[i]) return pack(RED);
      if (mode === "confidence") return pack(confidenceRamp(stage.rank[i] / 100));
      if (mode === "error") return pack(stage.error[i] === 255 ? GREY : errorRamp(stage.error[i] / 254));
      return pack([stage.rgb[3 * i], stage.rgb[3 * i + 1], stage.rgb[3 * i + 2]]);
    });
  }

  const state = { stage: "", colour: "photo", size: 2, conf: 0, cameras: true, removed: false };
  let view, isFirst;  // Whether the view is still the first one, which follows the size of the canvas.
  // All cameras and the points just fill the picture; points that lie far from the others do not make it smaller.
  function resetView() {
    view = { target: [0, 0, 0], distance: 0, yaw: scene.yaw, pitch: scene.pitch, fov: FOV };
    isFirst = true;
    const { back, right, up } = axes(), box = canvas.getBoundingClientRect(), stage = stages[state.stage];
    const tall = FILLED * Math.tan(FOV / 2), wide = tall * box.width / Math.max(1, box.height);
    const drawn = [...stage.cameras.flat(), ...stage.path];
    // A point is inside a plane of the view if what it gives here is at most what the eye gives.
    const reach = (axis, slope) => {
      const values = Float32Array.from(stage.shown, (i) => {
        const point = stage.xyz.subarray(3 * i, 3 * i + 3);
        return dot(axis, point) + slope * dot(back, point);
      }).sort();
      const at = (share) => values[Math.round(share * (values.length - 1))];
      const most = values.length ? Math.min(at(1), at(0.98) + 0.5 * (at(0.98) - at(0.5))) : -Infinity;
      return drawn.reduce((far, corner) => Math.max(far, dot(axis, corner) + slope * dot(back, corner)), most);
    };
    const [east, west] = [reach(right, wide), reach(right.map((value) => -value), wide)];
    const [north, south] = [reach(up, tall), reach(up.map((value) => -value), tall)];
    const away = Math.max((east + west) / (2 * wide), (north + south) / (2 * tall));
    const eye = [0, 1, 2].map((k) => right[k] * (east - west) / 2 + up[k] * (north - south) / 2 + back[k] * away);
    view.distance = Math.max(away - dot(back, scene.target), 0.1 * scene.radius);
    view.target = eye.map((value, k) => value - view.distance * back[k]);
  }
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const length = (a) => Math.hypot(...a);
  function axes() {
    const { yaw, pitch } = view;
    const back = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
    const right = [Math.cos(yaw), 0, -Math.sin(yaw)];
    const up = [
      back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0],
    ];
    const eye = view.target.map((value, k) => value + view.distance * back[k]);
    return { back, right, up, eye };
  }
  function lookFrom(number) {
    const corners = stages[state.stage].cameras[number];
    if (!corners) return;
    const middle = [0, 1, 2].map((k) => (corners[1][k] + corners[2][k] + corners[3][k] + corners[4][k]) / 4);
    const ahead = sub(middle, corners[0]), size = length(ahead);
    isFirst = false;
    view.distance = scene.radius;
    view.target = corners[0].map((value, k) => value + view.distance * ahead[k] / size);
    view.pitch = Math.asin(Math.min(Math.max(-ahead[1] / size, -1), 1));
    view.yaw = Math.atan2(-ahead[0], -ahead[2]);
    const left = [0, 1, 2].map((k) => (corners[1][k] + corners[4][k]) / 2 - middle[k]);
    const top = [0, 1, 2].map((k) => (corners[1][k] + corners[2][k]) / 2 - middle[k]);
    const box = canvas.getBoundingClientRect();
    view.fov = 2 * Math.atan(Math.max(length(top), length(left) * box.height / box.width) / size);
  }

  let image, pixels, depths;
  function resize() {
    const box = canvas.getBoundingClientRect();
    let ratio = Math.min(window.devicePixelRatio || 1, 2);
    ratio = Math.min(ratio, Math.sqrt(MOST_PIXELS / Math.max(1, box.width * box.height)));
    const width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
    if (image && canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    image = context.createImageData(width, height);
    pixels = new Uint32Array(image.data.buffer);
    depths = new Float32Array(width * height);
  }

  function drawPoints(stage, { back, right, up, eye }, focal) {
    const { width, height } = canvas, colours = coloursOf(stage, state.colour);
    const { xyz, kept, rank, width: widths, n } = stage, near = NEAR * scene.radius;
    const spread = Float32Array.from({ length: 256 }, (_, byte) => state.size * stage.spacing * focal * 2 ** ((byte - 128) / 16));
    pixels.fill(0);
    depths.fill(Infinity);
    for (let i = 0; i < n; i++) {
      if (kept[i] ? rank[i] < state.conf : !state.removed) continue;
      const x = xyz[3 * i] - eye[0], y = xyz[3 * i + 1] - eye[1], z = xyz[3 * i + 2] - eye[2];
      const depth = -(x * back[0] + y * back[1] + z * back[2]);
      if (depth < near) continue;
      const scale = focal / depth;
      const u = width / 2 + scale * (x * right[0] + y * right[1] + z * right[2]);
      const v = height / 2 - scale * (x * up[0] + y * up[1] + z * up[2]);
      const splat = Math.min(Math.max(spread[widths[i]] / depth, 1), BIGGEST_SPLAT), half = splat / 2;
      const top = Math.max(0, Math.round(v - half)), bottom = Math.min(height, Math.round(v + half) || 1);
      const key = Math.log2(depth), colour = colours[i], round = splat > 4;
      for (let row = top; row < bottom; row++) {
        const reach = round ? Math.sqrt(Math.max(0, half * half - (row + 0.5 - v) ** 2)) : half;
        const left = Math.max(0, Math.round(u - reach)), end = Math.min(width, Math.round(u + reach) || 1);
        for (let at = row * width + left, stop = row * width + end; at < stop; at++) {
          if (key < depths[at]) { depths[at] = key; pixels[at] = colour; }
        }
      }
    }
  }

  // Pixels behind their neighbours are darkened, which shows shape without normals.
  function shade() {
    const { width, height } = canvas, data = image.data, reach = Math.max(1, Math.round(width / 900));
    for (let row = reach; row < height - reach; row++) {
      for (let at = row * width + reach, stop = (row + 1) * width - reach; at < stop; at++) {
        const here = depths[at];
        if (here === Infinity) continue;
        let behind = 0;
        for (const other of [depths[at - reach], depths[at + reach], depths[at - reach * width], depths[at + reach * width]]) {
          if (other < here) behind += Math.min(here - other, 0.25);
        }
        if (behind > 0.01) {
          const light = 1 / (1 + SHADING * behind);
          data[4 * at] *= light; data[4 * at + 1] *= light; data[4 * at + 2] *= light;
        }
      }
    }
  }

  const EDGES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];
  function drawCameras(stage, { back, right, up, eye }, focal) {
    const { width, height } = canvas, near = NEAR * scene.radius;
    context.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue(`--${stage.key}`);
    context.lineWidth = Math.max(1, width / 900);
    context.beginPath();
    const place = (corner) => {
      const offset = sub(corner, eye), depth = -dot(offset, back);
      return depth < near ? null : [width / 2 + focal * dot(offset, right) / depth, height / 2 - focal * dot(offset, up) / depth];
    };
    const join = (a, b) => { if (a && b) { context.moveTo(...a); context.lineTo(...b); } };
    for (const corners of stage.cameras) {
      const placed = corners.map(place);
      for (const [a, b] of EDGES) join(placed[a], placed[b]);
    }
    context.stroke();
    if (stage.path.length) {
      const path = stage.path.map(place);
      context.lineWidth *= 2;
      context.beginPath();
      path.slice(1).forEach((end, k) => join(path[k], end));
      context.stroke();
    }
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      resize();
      const stage = stages[state.stage], around = axes(), focal = canvas.height / 2 / Math.tan(view.fov / 2);
      drawPoints(stage, around, focal);
      shade();
      context.putImageData(image, 0, 0);
      if (state.cameras) drawCameras(stage, around, focal);
    });
  }

  const pointers = new Map();
  let active = false;
  function turn(dx, dy) {
    view.yaw -= dx;
    view.pitch = Math.min(Math.max(view.pitch + dy, -1.55), 1.55);
  }
  function move(dx, dy) {
    const { right, up } = axes(), scale = view.distance * 2 * Math.tan(view.fov / 2) / canvas.clientHeight;
    view.target = view.target.map((value, k) => value - scale * dx * right[k] + scale * dy * up[k]);
  }
  function zoom(factor) {
    view.distance = Math.min(Math.max(view.distance * factor, 0.05 * scene.radius), 50 * scene.radius);
  }
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    active = true;
    isFirst = false;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    if (pointers.size === 1) {
      if (event.buttons & 2 || event.shiftKey) move(dx, dy);
      else turn(0.006 * dx, 0.006 * dy);
    } else {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const gap = (x, y) => Math.hypot(x - other[0], y - other[1]) || 1;
      zoom(gap(...before) / gap(event.clientX, event.clientY));
      move(dx / 2, dy / 2);
    }
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("pointerleave", () => { active = false; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  // The wheel scrolls the page until the view was clicked.
  canvas.addEventListener("wheel", (event) => {
    if (!active) return;
    event.preventDefault();
    isFirst = false;
    zoom(Math.exp(0.001 * event.deltaY));
    draw();
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const action = {
      ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
      "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1),
    }[event.key];
    if (!action) return;
    event.preventDefault();
    isFirst = false;
    action();
    draw();
  });

  function readControls() {
    const chosen = (name) => document.querySelector(`input[name="${name}"]:checked`).value;
    Object.assign(state, {
      stage: chosen("stage3d"), colour: chosen("colour3d"), size: Number(byId("size3d").value), conf: Number(byId("conf3d").value),
      cameras: byId("cameras3d").checked, removed: byId("removed3d").checked,
    });
    byId("conf3dText").textContent = `${state.conf} %`;
  }
  const follow = () => { if (byId("camera3d").value !== "") lookFrom(Number(byId("camera3d").value)); };
  for (const control of document.querySelectorAll("#scene input")) {
    control.addEventListener("input", () => {
      readControls();
      if (control.name === "stage3d") follow();
      draw();
    });
  }
  byId("camera3d").addEventListener("change", () => {
    if (byId("camera3d").value === "") resetView();
    follow();
    draw();
  });
  byId("reset3d").addEventListener("click", () => {
    byId("camera3d").value = "";
    resetView();
    draw();
  });
  new ResizeObserver(() => {
    if (isFirst) resetView();
    draw();
  }).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  readControls();
  resetView();
  follow();
  draw();
})();
