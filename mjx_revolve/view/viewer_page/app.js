// The page: reads the episode, draws it, and listens to buttons, keys, mouse and touch.

function start() {
  const data = JSON.parse(byId("episode").textContent);
  const size = data.length, world = data.world;
  const asked = new URLSearchParams(location.hash.slice(1));
  const stage = openStage(world, size);
  if (stage === null) return;
  const { scene, target, here, dust, surface, draw, zoom, pen, write } = stage;

  // ------------------------------------------------------------------ the picture

  const step = data.step, last = step * (data.count - 1);
  const robot = makeRobot(data.robot, step);
  const gridStep = roundNumber(0.6 * size), grid = makeGrid(data.floor, size, gridStep, world.bed === null);
  const core = new Track(data.core, 3, step), center = new Track(data.center, 3, step);
  const drift = new Track(data.drift, 3, step), speed = new Track(data.speed, 1, step);
  const trail = makeTrail(core, data), place = new THREE.Vector3();
  scene.add(robot.group, grid, trail.mesh);
  const current = data.current && makeCurrent(data.current, step, size);
  if (current) scene.add(current.group);
  const goal = data.target && new Track(data.target, 3, step), mark = goal && makeTarget(size);
  if (mark) scene.add(mark.group);
  const arrows = {};
  for (const name in data.forces) {
    arrows[name] = makeArrows(data.forces[name], data.anchors, robot, step, size);
    scene.add(arrows[name].group);
  }

  function look(view) {
    center.vector(state.time, 0, target);
    stage.look(view, data.heading);
  }

  // ------------------------------------------------------------------ time

  const state = { time: 0, playing: true, rate: 1, follow: true };

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

  const toggle = stage.switches(shown);
  for (const name in data.forces) {
    if (data.forces[name].scale !== 0) continue;
    byId(name).disabled = true;
    byId(name).title = data.forces[name].why ?? `no ${name} in this episode`;
  }
  byId("grid").title = `level lines, ${gridStep} m apart (G)`;
  byId("grid").querySelector("small").textContent = `${gridStep} m`;
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => look(VIEWS[button.dataset.view]));
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
  Object.keys(VIEWS).forEach((name, k) => (keys[k + 1] = () => look(VIEWS[name])));
  for (const letter in letters) keys[letter] = () => toggle(letters[letter]);
  stage.listen(keys);

  function stretch(by) {
    for (const name in arrows) arrows[name].scale *= by;
    draw();
  }

  // ------------------------------------------------------------------ instruments

  const aim = new THREE.Vector3();

  function drawInstruments() {
    core.vector(state.time, 0, place);
    const v = speed.at(state.time, 0, 1, [0])[0], from = core.values;
    write("time", `${(data.start + state.time).toFixed(2)} s`);
    write("speed", `${v.toFixed(3)} m/s`);
    write("lengths", `${(v / size).toFixed(2)} body lengths/s`);
    const depth = world.surface - place.z;
    write("depth", `${depth.toFixed(2)} m`);
    if (current) write("current", `${current.at(state.time).toFixed(3)} m/s`);
    if (goal) goal.vector(state.time, 0, aim);
    if (goal) write("target", `${place.distanceTo(aim).toFixed(2)} m`);
    write("way", `${Math.hypot(place.x - from[0], place.y - from[1], place.z - from[2]).toFixed(2)} m`);
    scrub.value = state.time;
    byId("clock").textContent = `${(data.start + state.time).toFixed(1)} / ${(data.start + last).toFixed(1)} s`;
    drawSpeed();
    stage.drawAxes();
    stage.drawGauge(depth, data.deepest, world.surface - stage.bedAt(place.x, place.y));
    const pixels = stage.pixelsPerMetre();
    for (const name in arrows) {
      if (arrows[name].scale === 0) continue;
      const perNewton = arrows[name].scale * pixels, force = roundNumber((innerWidth > 760 ? 64 : 44) / perNewton);
      const bar = document.querySelector(`#${name} .bar`), label = document.querySelector(`#${name} .unit`);
      bar.style.width = `${(force * perNewton).toFixed(1)}px`;
      label.textContent = `${digits(force)} N`;
    }
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

  // ------------------------------------------------------------------ frames

  stage.resized = () => trail.material.uniforms.uScreen.value.set(innerWidth / 2, innerHeight / 2);

  function moves(passed) {
    if (!state.playing) return false;
    state.time += passed * state.rate;
    if (state.time > last) state.time = last > 0 ? state.time % last : 0; // over again
    return true;
  }

  function update() {
    const time = state.time;
    robot.update(time);
    if (mark) mark.update(goal.vector(time, 0, aim));
    stage.place(data.start + time, center.vector(time, 0, place), state.follow);
    dust.material.uniforms.uDrift.value = drift.vector(time, 0, dust.material.uniforms.uDrift.value);
    trail.material.uniforms.uNow.value = time;
    if (current && current.group.visible) current.update(time, here);
    for (const name in arrows) if (arrows[name].group.visible) arrows[name].update(time);
  }

  function told() {
    drawInstruments();
    status.time = (data.start + state.time).toFixed(4);
  }

  // ------------------------------------------------------------------ how to begin

  stage.resize();
  const number = (name, usual) => (asked.has(name) && asked.get(name) !== "" ? Number(asked.get(name)) : usual);
  seek(number("t", data.start) - data.start);
  setRate(rates.includes(number("rate", 1)) ? number("rate", 1) : 1);
  for (const name of (asked.get("show") || "").split(",")) if (name in shown) toggle(name, true);
  for (const name of (asked.get("hide") || "").split(",")) if (name in shown) toggle(name, false);
  const view = VIEWS[asked.get("view")] || VIEWS.swim;
  look({
    azimuth: number("azimuth", view.azimuth),
    elevation: number("elevation", view.elevation),
    distance: number("distance", 1),
  });
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  play(!asked.has("paused") && !calm);
  if (asked.has("plain")) document.body.classList.add("plain");
  status.ready = "true";
  stage.run({ moves, update, told });
}

start();
