// The page: reads the episode, draws it, and listens to buttons, keys, mouse and touch.

const byId = (id) => document.getElementById(id);
const status = document.documentElement.dataset; // what a test may read: time, playing, frames

function fail(message) {
  byId("message").textContent = message;
  byId("message").hidden = false;
  status.error = message;
}

// The largest of 1, 2, 5 times a power of ten up to x.
function roundNumber(x) {
  const power = 10 ** Math.floor(Math.log10(x)), digit = x / power;
  return Number(((digit >= 5 ? 5 : digit >= 2 ? 2 : 1) * power).toPrecision(1)); // 0.2, not 0.2000…1
}

function digits(x) {
  return String(Number(x.toPrecision(2)));
}

function start() {
  const data = JSON.parse(byId("episode").textContent);
  const size = data.length, world = data.world;
  const asked = new URLSearchParams(location.hash.slice(1));
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: byId("view"), antialias: true });
  } catch {
    fail("This page draws with WebGL 2, which this browser does not offer or has switched off.");
    return;
  }
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    const log = [vertex, fragment].map((shader) => gl.getShaderInfoLog(shader)).join(" ").trim();
    fail(`A shader did not compile: ${log}`);
    console.error(log);
  };

  maxWaves = Math.max(1, world.waves.length);
  shared.uWaves.value = Array.from({ length: maxWaves }, () => new THREE.Vector4());
  shared.uFade.value = world.waves.length ? world.waves.map((wave) => wave.k) : [0];
  shared.uSurface.value = world.surface;
  shared.uSize.value = size;

  // ------------------------------------------------------------------ the picture

  const step = data.step, last = step * (data.count - 1);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(38, 1, 0.02 * size, 3000);
  camera.up.set(0, 0, 1);
  const robot = makeRobot(data.robot, step), background = makeBackground(), surface = makeSurface(size);
  const gridStep = roundNumber(0.6 * size), grid = makeGrid(data.floor, size, gridStep, world.bed === null);
  const dust = makeDust(size), shadow = makeShadow(size);
  const core = new Track(data.core, 3, step), center = new Track(data.center, 3, step);
  const drift = new Track(data.drift, 3, step), speed = new Track(data.speed, 1, step);
  const trail = makeTrail(core, data);
  scene.add(background.mesh, robot.group, surface.mesh, grid, dust.points, trail.mesh);
  if (world.bed !== null) scene.add(makeBed(world.bed));
  const current = data.current && makeCurrent(data.current, step, size);
  if (current) scene.add(current.group);
  const goal = data.target && new Track(data.target, 3, step), mark = goal && makeTarget(size);
  if (mark) scene.add(mark.group);
  const arrows = {};
  for (const name in data.forces) {
    arrows[name] = makeArrows(data.forces[name], data.anchors, robot, step, size);
    scene.add(arrows[name].group);
  }

  // ------------------------------------------------------------------ the camera

  const controls = new THREE.OrbitControls(camera, renderer.domElement);
  controls.enableDamping = true;
  controls.dampingFactor = 0.12;
  controls.minDistance = 0.3 * size;
  controls.maxDistance = 60 * size;
  controls.zoomSpeed = 0.8;
  const target = controls.target, here = new THREE.Vector3();

  function look(view) {
    const { azimuth, elevation, distance = 1 } = view;
    center.vector(state.time, 0, target);
    const narrow = Math.min(1, camera.aspect), reach = (distance * 0.86 * size) / Math.tan((camera.fov * Math.PI) / 360) / narrow;
    const a = ((data.heading + azimuth) * Math.PI) / 180;
    let e = (elevation * Math.PI) / 180;
    // A camera in the surface sees neither side of it well.
    const above = (x) => target.z + reach * Math.sin(x) - world.surface;
    if (Math.abs(elevation) < 60 && above(e) > -0.25 * size && above(e) < 0.45 * size) {
      e = Math.asin(Math.min(0.8, (world.surface + 0.45 * size - target.z) / reach));
    }
    camera.position.set(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
    camera.position.multiplyScalar(reach).add(target);
    controls.update();
    draw();
  }

  // Seen so that the robot swims to the right, a little towards the viewer.
  const views = {
    swim: { azimuth: -72, elevation: 11 },
    side: { azimuth: -90, elevation: 0 },
    top: { azimuth: -90, elevation: 89.5 },
    front: { azimuth: 12, elevation: 8 },
    below: { azimuth: -60, elevation: -28 },
  };

  function bedAt(x, y) {
    if (world.bed === null) return -Infinity;
    const { center: c, radius, height, sectors, rings } = bedTable;
    const r = Math.hypot(x - c[0], y - c[1]), angle = Math.atan2(y - c[1], x - c[0]) / (2 * Math.PI);
    let i = 0;
    while (i + 2 < rings && radius[i + 1] < r) i++;
    const s = Math.min(Math.max((r - radius[i]) / (radius[i + 1] - radius[i]), 0), 1);
    const j = (((angle % 1) + 1) % 1) * sectors, j0 = Math.floor(j), t = j - j0;
    const at = (a, b) => height[a * sectors + (b % sectors)];
    const ring = (a) => at(a, j0) * (1 - t) + at(a, j0 + 1) * t;
    return ring(i) * (1 - s) + ring(i + 1) * s;
  }
  const bedTable = world.bed && {
    ...world.bed, radius: numbersOf(world.bed.radius), height: numbersOf(world.bed.height),
  };

  // ------------------------------------------------------------------ time

  const state = { time: 0, playing: true, rate: 1, follow: true };
  let dirty = true, frames = 0;
  const draw = () => (dirty = true);

  function seek(time) {
    state.time = Math.min(Math.max(time, 0), last);
    draw();
  }

  function play(on) {
    if (on && state.time >= last) state.time = 0;
    state.playing = on;
    byId("play").setAttribute("aria-label", on ? "pause" : "play");
    byId("play").classList.toggle("playing", on);
    status.playing = on;
    draw();
  }

  const rates = [0.25, 0.5, 1, 2, 4];
  function setRate(rate) {
    state.rate = rate;
    byId("rate").value = String(rate);
  }

  // ------------------------------------------------------------------ switches

  const shown = {
    follow: (on) => (state.follow = on),
    trail: (on) => (trail.mesh.visible = on),
    grid: (on) => (grid.visible = on),
    water: (on) => {
      surface.mesh.visible = dust.points.visible = on;
      if (current) current.group.visible = on;
    },
  };
  for (const name in arrows) shown[name] = (on) => (arrows[name].group.visible = on);

  function toggle(name, on) {
    const button = byId(name);
    if (button.disabled) return;
    const next = on ?? button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(next));
    shown[name](next);
    draw();
  }

  for (const name in shown) {
    const button = byId(name);
    button.addEventListener("click", () => toggle(name));
    shown[name](button.getAttribute("aria-pressed") === "true");
    if (name in data.forces && data.forces[name].scale === 0) {
      button.disabled = true;
      button.title = data.forces[name].why ?? `no ${name} in this episode`;
    }
  }
  byId("grid").title = `level lines, ${gridStep} m apart (G)`;
  byId("grid").querySelector("small").textContent = `${gridStep} m`;
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => look(views[button.dataset.view]));
  }
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("rate").addEventListener("change", (event) => setRate(Number(event.target.value)));
  const scrub = byId("scrub");
  scrub.max = last;
  scrub.step = step / 4;
  scrub.addEventListener("input", () => seek(Number(scrub.value)));

  const letters = { f: "follow", t: "trail", g: "grid", w: "water", b: "buoyancy", d: "drag", h: "thrust" };
  const nextRate = (by) => setRate(rates[Math.min(Math.max(rates.indexOf(state.rate) + by, 0), rates.length - 1)]);
  const keys = {
    " ": () => play(!state.playing),
    ArrowLeft: (event) => seek(state.time - (event.shiftKey ? 1 : 0.1)),
    ArrowRight: (event) => seek(state.time + (event.shiftKey ? 1 : 0.1)),
    ArrowUp: () => nextRate(1),
    ArrowDown: () => nextRate(-1),
    Home: () => seek(0),
    End: () => seek(last),
    "+": () => zoom(0.85),
    "-": () => zoom(1 / 0.85),
    "[": () => stretch(1 / 1.25),
    "]": () => stretch(1.25),
  };
  Object.keys(views).forEach((name, k) => (keys[k + 1] = () => look(views[name])));

  function zoom(by) {
    const arm = camera.position.clone().sub(target).multiplyScalar(by);
    arm.setLength(Math.min(Math.max(arm.length(), controls.minDistance), controls.maxDistance));
    camera.position.copy(target).add(arm);
    draw();
  }

  function stretch(by) {
    for (const name in arrows) arrows[name].scale *= by;
    draw();
  }

  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === " " && event.target instanceof HTMLButtonElement) return; // presses it
    const name = letters[event.key.toLowerCase()], action = keys[event.key];
    if (name) toggle(name);
    else if (action) action(event);
    else return;
    event.preventDefault();
  });
  controls.addEventListener("change", draw);

  // ------------------------------------------------------------------ instruments

  const readings = Object.fromEntries(["time", "speed", "lengths", "depth", "way", "current", "target"].map((id) => [id, byId(id)]));

  function write(id, text) {
    if (readings[id].textContent !== text) readings[id].textContent = text;
  }

  const aim = new THREE.Vector3();

  function drawInstruments() {
    core.vector(state.time, 0, here);
    const v = speed.at(state.time, 0, 1, [0])[0], from = core.values;
    write("time", `${(data.start + state.time).toFixed(2)} s`);
    write("speed", `${v.toFixed(3)} m/s`);
    write("lengths", `${(v / size).toFixed(2)} body lengths/s`);
    const depth = world.surface - here.z;
    write("depth", `${depth.toFixed(2)} m`);
    if (current) write("current", `${current.at(state.time).toFixed(3)} m/s`);
    if (goal) goal.vector(state.time, 0, aim);
    if (goal) write("target", `${here.distanceTo(aim).toFixed(2)} m`);
    write("way", `${Math.hypot(here.x - from[0], here.y - from[1], here.z - from[2]).toFixed(2)} m`);
    scrub.value = state.time;
    byId("clock").textContent = `${(data.start + state.time).toFixed(1)} / ${(data.start + last).toFixed(1)} s`;
    drawSpeed();
    drawAxes();
    drawGauge(depth);
    const pixels = pixelsPerMetre();
    for (const name in arrows) {
      if (arrows[name].scale === 0) continue;
      const perNewton = arrows[name].scale * pixels, force = roundNumber((innerWidth > 760 ? 64 : 44) / perNewton);
      const bar = document.querySelector(`#${name} .bar`), label = document.querySelector(`#${name} .unit`);
      bar.style.width = `${(force * perNewton).toFixed(1)}px`;
      label.textContent = `${digits(force)} N`;
    }
  }

  function pixelsPerMetre() {
    const far = camera.position.distanceTo(target);
    return renderer.domElement.clientHeight / (2 * far * Math.tan((camera.fov * Math.PI) / 360));
  }

  // A 2D canvas as sharp as the screen.
  function pen(id) {
    const canvas = byId(id), ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = canvas;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, w, h);
    context.font = "11px system-ui, sans-serif";
    return { context, w, h };
  }

  const fastest = speed.values.reduce((a, b) => Math.max(a, b), 1e-6);

  function drawSpeed() {
    const { context: c, w, h } = pen("chart"), pad = 8, span = w - 2 * pad;
    const x = (time) => pad + (time / Math.max(last, 1e-9)) * span, y = (v) => h - 3 - (v / fastest) * (h - 8);
    const area = (until) => {
      c.beginPath();
      c.moveTo(pad, h);
      for (let i = 0; i <= span; i += 2) {
        const time = (i / span) * last;
        if (time > until) break;
        c.lineTo(pad + i, y(speed.at(time, 0, 1, [0])[0]));
      }
      c.lineTo(x(until), y(speed.at(until, 0, 1, [0])[0]));
      c.lineTo(x(until), h);
      c.fill();
    };
    c.fillStyle = "rgba(190, 235, 240, 0.22)";
    area(last);
    c.fillStyle = "rgba(255, 140, 60, 0.75)";
    area(state.time);
    c.fillStyle = "#fff";
    c.fillRect(x(state.time) - 1, 0, 2, h);
    c.fillStyle = "rgba(235, 250, 252, 0.8)";
    c.textAlign = "right";
    c.textBaseline = "top";
    c.fillText(`speed, up to ${digits(fastest)} m/s`, w - pad - 4, y(fastest) + 3);
  }

  function drawAxes() {
    const { context: c, w, h } = pen("axes"), arm = 0.32 * w;
    const along = ["x", "y", "z"].map((name, k) => {
      const d = new THREE.Vector3().setComponent(k, 1).applyQuaternion(camera.quaternion.clone().invert());
      return { name, d, color: ["#ff7b6b", "#8fe388", "#7cc4ff"][k] };
    });
    along.sort((a, b) => a.d.z - b.d.z);
    c.lineWidth = 2;
    c.textAlign = "center";
    c.textBaseline = "middle";
    for (const { name, d, color } of along) {
      c.strokeStyle = c.fillStyle = color;
      c.beginPath();
      c.moveTo(w / 2, h / 2);
      c.lineTo(w / 2 + arm * d.x, h / 2 - arm * d.y);
      c.stroke();
      c.fillText(name, w / 2 + (arm + 8) * d.x, h / 2 - (arm + 8) * d.y);
    }
  }

  // Depth below the surface, down to the bed or as deep as the way goes.
  const deepest = data.deepest, tick = roundNumber(deepest / 3.2);

  function drawGauge(depth) {
    const { context: c, w, h } = pen("gauge"), top = 27, bottom = h - 10, x = 40;
    const y = (d) => top + ((bottom - top) * Math.min(Math.max(d, -0.05 * deepest), deepest)) / deepest;
    const water = c.createLinearGradient(0, top, 0, bottom);
    water.addColorStop(0, "rgba(120, 220, 230, 0.85)");
    water.addColorStop(1, "rgba(10, 50, 90, 0.85)");
    c.fillStyle = water;
    c.fillRect(x, top, 7, bottom - top);
    c.fillStyle = c.strokeStyle = "rgba(235, 250, 252, 0.85)";
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (let d = 0; d <= deepest * 1.001; d += tick) {
      c.fillRect(x - 4, y(d) - 0.5, 4, 1);
      c.fillText(`${digits(d)}`, x - 7, y(d));
    }
    c.textAlign = "left";
    c.fillText("depth [m]", 4, 7);
    const floor = world.surface - bedAt(here.x, here.y);
    if (floor < deepest) {
      c.fillStyle = "#c9b07a";
      c.fillRect(x - 1, y(floor), 9, bottom - y(floor) + 3);
      if (y(floor) - y(depth) > 13) c.fillText("bed", x + 13, Math.min(y(floor) + 5, h - 6));
    }
    c.fillStyle = "#ff8c3c";
    c.beginPath();
    c.moveTo(x + 8, y(depth));
    c.lineTo(x + 17, y(depth) - 6);
    c.lineTo(x + 17, y(depth) + 6);
    c.fill();
    c.fillText(depth.toFixed(2), x + 20, y(depth));
  }

  // ------------------------------------------------------------------ frames

  let pixelRatio = Math.min(devicePixelRatio || 1, 2);

  function resize() {
    renderer.setPixelRatio(pixelRatio);
    renderer.setSize(innerWidth, innerHeight, false);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
    trail.material.uniforms.uScreen.value.set(innerWidth / 2, innerHeight / 2);
    dust.material.uniforms.uPixels.value = (innerHeight * pixelRatio) / (2 * Math.tan((camera.fov * Math.PI) / 360));
    draw();
  }
  addEventListener("resize", resize);

  const before = new THREE.Vector3();

  function update() {
    const time = state.time;
    shared.uTime.value = data.start + time;
    world.waves.forEach((wave, k) => {
      const phase = wave.phase - wave.omega * (data.start + time);
      shared.uWaves.value[k].set(wave.k * wave.x, wave.k * wave.y, wave.amplitude, phase % (2 * Math.PI));
    });
    robot.update(time);
    if (mark) mark.update(goal.vector(time, 0, aim));
    center.vector(time, 0, here);
    if (state.follow) {
      before.copy(target);
      target.copy(here);
      camera.position.add(before.subVectors(target, before));
    }
    controls.update();
    const ground = bedAt(camera.position.x, camera.position.y) + 0.06 * size;
    if (camera.position.z < ground) {
      camera.position.z = ground;
      camera.lookAt(target);
    }
    camera.updateMatrixWorld();
    shared.uEye.value.copy(camera.position);
    shared.uTarget.value.copy(here);
    dust.material.uniforms.uDrift.value = drift.vector(time, 0, dust.material.uniforms.uDrift.value);
    trail.material.uniforms.uNow.value = time;
    if (current && current.group.visible) current.update(time, here);
    background.update(camera);
    surface.update(here, camera.position);
    for (const name in arrows) if (arrows[name].group.visible) arrows[name].update(time);
  }

  let lastTick = performance.now(), slow = 0;

  function tickFrame(now) {
    requestAnimationFrame(tickFrame);
    // The first tick may lie before the script's own time, and a hidden page has none for long.
    const passed = Math.min(Math.max((now - lastTick) / 1000, 0), 0.25);
    lastTick = now;
    if (state.playing) {
      state.time += passed * state.rate;
      if (state.time > last) state.time = last > 0 ? state.time % last : 0; // over again
      dirty = true;
      // A slow machine gets plain panels, then fewer pixels, rather than fewer frames.
      slow = passed > 0.05 ? slow + (passed > 0.12 ? 4 : 1) : Math.max(0, slow - 1);
      if (slow > 12 && !document.body.classList.contains("plain")) {
        document.body.classList.add("plain");
        slow = 0;
      } else if (slow > 12 && pixelRatio > 0.5) {
        pixelRatio = Math.max(0.5, pixelRatio * 0.75);
        slow = 0;
        resize();
      }
    }
    if (controls.update()) dirty = true;
    if (!dirty) return;
    dirty = false;
    update();
    shadow.render(renderer, scene, here);
    renderer.clear();
    renderer.render(scene, camera);
    drawInstruments();
    status.time = (data.start + state.time).toFixed(4);
    status.frames = ++frames;
  }

  // ------------------------------------------------------------------ how to begin

  resize();
  const number = (name, usual) => (asked.has(name) && asked.get(name) !== "" ? Number(asked.get(name)) : usual);
  seek(number("t", data.start) - data.start);
  setRate(rates.includes(number("rate", 1)) ? number("rate", 1) : 1);
  for (const name of (asked.get("show") || "").split(",")) if (name in shown) toggle(name, true);
  for (const name of (asked.get("hide") || "").split(",")) if (name in shown) toggle(name, false);
  const view = views[asked.get("view")] || views.swim;
  look({
    azimuth: number("azimuth", view.azimuth),
    elevation: number("elevation", view.elevation),
    distance: number("distance", 1),
  });
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  play(!asked.has("paused") && !calm);
  if (asked.has("plain")) document.body.classList.add("plain");
  status.ready = "true";
  requestAnimationFrame(tickFrame);
}

start();
