// A running world's page: listens to what happens there, draws it, and asks for what the user wants.

const DELAY = 0.16; // s of real time behind the world, so that there is always a pose to go to
const FASTEST = 0.5; // m/s at the compass's rim

function packNow(values) {
  return { f32: btoa(String.fromCharCode(...new Uint8Array(new Float32Array(values).buffer))) };
}

function start() {
  const data = JSON.parse(byId("episode").textContent), size = data.length, { world } = data;
  const asked = new URLSearchParams(location.hash.slice(1));
  const stage = openStage(world, size);
  if (stage === null) return;
  const { scene, target, dust, surface, draw, zoom, write, controls, camera } = stage;
  const shapes = {}, shoal = new Shoal(stage, shapes), chart = new Chart(stage, shoal);
  const gridStep = roundNumber(Math.max(0.6 * size, 0.5)), grid = makeGrid(data.floor, 4 * size, gridStep, world.bed === null);
  scene.add(grid);
  controls.maxDistance = 120 * size;
  const state = {
    clock: null, newest: null, paused: false, rate: 1, speed: 0, current: data.current, followed: null,
    going: false, drift: new THREE.Vector3(), aiming: false, over: null, ask: 0,
  };

  // ------------------------------------------------------------------ asking

  let noteTimer = 0;

  function say(text, bad = false) {
    const note = byId("note");
    note.textContent = text;
    note.classList.toggle("bad", bad);
    note.hidden = false;
    clearTimeout(noteTimer);
    noteTimer = setTimeout(() => (note.hidden = true), bad ? 6000 : 3500);
    status.note = text;
  }

  async function ask(wish) {
    try {
      const answer = await fetch("wish", {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(wish),
      });
      const told = await answer.json();
      if (!answer.ok) say(told.error, true);
      status.asked = String(++state.ask);
      return told;
    } catch {
      say("The world does not answer.", true);
      return {};
    }
  }

  // ------------------------------------------------------------------ listening

  const listen = new EventSource("events"), waiting = byId("busy");
  let busy = true;

  function wait(text) {
    busy = text !== null;
    waiting.hidden = !busy;
    if (busy) waiting.lastChild.textContent = text;
    status.busy = busy;
    draw();
  }

  const on = (name, act) => listen.addEventListener(name, (event) => act(JSON.parse(event.data)));
  listen.addEventListener("open", () => wait("waiting for the water…"));
  listen.addEventListener("error", () => wait("no connection: has the command ended?"));

  on("note", (text) => say(text, true));

  on("state", (now) => {
    Object.assign(state, { paused: now.paused, rate: now.rate, speed: now.speed });
    // Who drags the arrow now knows better.
    if (!holding) state.current = now.current;
    now.waves.forEach((wave, k) => Object.assign(world.waves[k] ?? {}, wave));
    byId("play").classList.toggle("playing", !now.paused);
    byId("play").setAttribute("aria-label", now.paused ? "go on" : "pause");
    if (![...byId("rate").options].some((option) => option.selected && Number(option.value) === now.rate)) {
      byId("rate").value = String(now.rate);
    }
    if (now.busy) wait(`compiling… ${now.busy.toFixed(0)} s`);
    else if (state.newest !== null || now.paused) wait(null);
    status.paused = now.paused;
    status.current = now.current.join();
    showFlow();
    draw();
  });

  let cast = [];

  on("cast", (now) => {
    cast = now;
    const keys = new Set(now.map(({ key }) => key));
    for (const swimmer of shoal.there.values()) if (!keys.has(swimmer.key)) swimmer.leaving = true;
    if (state.followed !== null && !keys.has(state.followed)) follow(null);
    for (const one of now) if (!shoal.there.has(one.key)) admit(one);
    showList();
  });

  const loading = {};

  async function bodyOf(number) {
    loading[number] ??= fetch(`body/${number}`).then((answer) => answer.json());
    const body = await loading[number];
    Object.assign(shapes, body.shapes);
    return shoal.bodyOf(number, body);
  }

  async function admit(one) {
    const body = await bodyOf(one.body);
    if (shoal.there.has(one.key) || !cast.some(({ key }) => key === one.key)) return;
    const swimmer = shoal.add(one.key, body, one.name, chipOf(one.key));
    Object.assign(swimmer, { times: [], poses: [], born: one.born, way: [], from: one.start });
    swimmer.group.visible = false;
    if (early.has(one.key)) take(swimmer, ...early.get(one.key));
    early.delete(one.key);
    if (state.wanted === one.key) {
      follow(one.key);
      state.wanted = null;
    }
    showList();
    draw();
  }

  const early = new Map(); // the last pose of who is still being drawn up: [time, pose]

  function take(swimmer, time, pose) {
    const { times, poses } = swimmer;
    if (times.length && time <= times[times.length - 1]) return;
    times.push(time);
    poses.push(pose);
  }

  on("poses", (now) => {
    const numbers = new Float32Array(bytesOf(now.q)), count = now.t.length;
    let at = 0;
    now.keys.forEach((key, k) => {
      const width = now.widths[k], swimmer = shoal.there.get(key);
      for (let row = 0; row < count; row++, at += width) {
        const pose = numbers.subarray(at, at + width);
        if (swimmer) take(swimmer, now.t[row], pose);
        else early.set(key, [now.t[row], pose]);
      }
      if (!swimmer) return;
      const last = swimmer.poses[swimmer.poses.length - 1];
      const way = swimmer.way, t = now.t[count - 1];
      if (!way.length || t - way[way.length - 1][0] >= 0.25) way.push([t, last[0], last[1], last[2]]);
      if (way.length > 480) way.shift();
    });
    state.newest = now.t[count - 1];
    if (state.clock === null || Math.abs(state.newest - state.clock) > 1.5) state.clock = state.newest;
    if (busy) wait(null);
    status.poses = String(state.newest);
    draw();
  });

  // Where a robot is at the clock's time; null before its first pose.
  const pose = [];

  function poseAt(swimmer) {
    const { times, poses } = swimmer;
    if (!times.length) return null;
    let i = times.length - 1;
    while (i > 0 && times[i] > state.clock) i--;
    if (i > 40) {
      times.splice(0, i - 20);
      poses.splice(0, i - 20);
      i = 20;
    }
    const j = Math.min(i + 1, times.length - 1), a = poses[i], b = poses[j];
    const share = j > i ? Math.min(Math.max((state.clock - times[i]) / (times[j] - times[i]), 0), 1) : 0;
    return mixPoses(a, 0, b, 0, share, a.length, pose);
  }

  // ------------------------------------------------------------------ who is there

  const lines = new Map();

  function showList() {
    const keys = new Set(cast.map(({ key }) => key));
    for (const key of [...lines.keys()]) if (!keys.has(key)) lines.delete(key);
    for (const { key, name } of cast) {
      if (lines.has(key)) continue;
      const line = document.createElement("li");
      line.setAttribute("role", "option");
      line.innerHTML = "<i></i><b></b><em></em><button>×</button>";
      const [mark, words, , out] = line.children;
      mark.style.background = chipOf(key);
      words.textContent = words.title = name;
      out.title = out.ariaLabel = `take ${name} out`;
      out.addEventListener("click", (event) => {
        event.stopPropagation();
        ask({ do: "remove", key });
      });
      line.addEventListener("click", () => follow(state.followed === key ? null : key));
      line.addEventListener("pointerenter", () => point(key));
      line.addEventListener("pointerleave", () => point(null));
      lines.set(key, line);
    }
    for (const [key, line] of lines) line.setAttribute("aria-selected", key === state.followed);
    const none = document.createElement("li");
    none.className = "none";
    none.textContent = "nobody: drop one";
    byId("list").replaceChildren(...(lines.size ? lines.values() : [none]));
    write("count", `${cast.length} of ${data.room}`);
    status.robots = String(cast.length);
  }

  function point(key) {
    shoal.pointed = key;
    draw();
  }

  function follow(key) {
    state.followed = key;
    state.going = key !== null;
    byId("follow").setAttribute("aria-pressed", key !== null);
    byId("who").hidden = key === null;
    const swimmer = shoal.there.get(key);
    if (swimmer) {
      const [mark, name] = byId("who").firstChild.children;
      mark.style.background = swimmer.color;
      name.textContent = swimmer.name;
    }
    for (const [other, line] of lines) line.setAttribute("aria-selected", other === key);
    status.followed = key ?? "";
    draw();
  }

  function step(by) {
    const keys = cast.map(({ key }) => key);
    if (keys.length) follow(keys[(keys.indexOf(state.followed) + by + keys.length) % keys.length]);
  }

  // ------------------------------------------------------------------ dropping

  const stock = byId("stock"), groups = new Map();
  data.stock.forEach(({ name, group }, k) => {
    if (!groups.has(group)) {
      const box = document.createElement("optgroup");
      box.label = group;
      groups.set(group, box);
      stock.append(box);
    }
    groups.get(group).append(new Option(name, k));
  });
  stock.selectedIndex = 0;
  const deep = byId("deep"), depth = () => Number(deep.value);
  const showDepth = () => (byId("deepness").textContent = `${depth().toFixed(2)} m`);
  deep.addEventListener("input", showDepth);
  showDepth();

  async function drop(place = null) {
    const wish = { do: "drop", who: Number(stock.value), depth: depth() };
    if (place) wish.place = place.map((x) => Math.min(500, Math.max(-500, Number(x.toFixed(3)))));
    const told = await ask(wish);
    if (told.later) say("compiling: the robot comes in a moment");
    if (told.key === undefined || told.key === null) return;
    const known = shoal.there.get(told.key);
    if (known && !place) follow(told.key);
    else if (!place) state.wanted = told.key;
  }

  function aim(on) {
    state.aiming = on;
    state.over = null;
    byId("aim").setAttribute("aria-pressed", on);
    document.body.classList.toggle("aiming", on);
    draw();
  }

  const canvas = byId("view");
  const under = (x, y) => onPlane(stage, x, y, world.surface - depth(), 0.9 * controls.maxDistance);

  function dropUnder(x, y) {
    const place = under(x, y);
    if (place === null) say("That is the horizon: click further down.", true);
    else drop([place.x, place.y]);
  }

  onClick(canvas, (x, y, event) => {
    if (state.aiming) {
      dropUnder(x, y);
      if (!event.shiftKey) aim(false);
      return;
    }
    const key = shoal.pick(x, y);
    if (key !== null) follow(key);
  });
  canvas.addEventListener("dblclick", (event) => {
    if (shoal.pick(event.clientX, event.clientY) === null) dropUnder(event.clientX, event.clientY);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (state.aiming) {
      state.over = [event.clientX, event.clientY];
      draw();
      return;
    }
    const key = event.buttons ? null : shoal.pick(event.clientX, event.clientY);
    canvas.style.cursor = key === null ? "" : "pointer";
    if (key !== shoal.pointed) point(key);
  });
  byId("map").addEventListener("click", (event) => {
    const { key, place } = chart.onMap(event);
    if (state.aiming) {
      drop(place);
      aim(false);
    } else if (key !== null) follow(key);
    else {
      follow(null);
      const to = new THREE.Vector3(...place, target.z);
      camera.position.add(to).sub(target);
      target.copy(to);
      draw();
    }
  });
  byId("drop").addEventListener("click", () => drop());
  byId("aim").addEventListener("click", () => aim(!state.aiming));

  // ------------------------------------------------------------------ the current

  const compass = byId("compass"), lift = byId("lift");
  let holding = false, sending = false, pending = false, arrow = null;

  // One wish at a time, and the latest after it.
  async function flow(velocity) {
    state.current = velocity.map((v) => Number(v.toFixed(4)));
    showFlow();
    draw();
    if (sending) return (pending = true);
    sending = true;
    do {
      pending = false;
      await ask({ do: "current", velocity: state.current });
    } while (pending);
    sending = false;
  }

  function showFlow() {
    const [x, y, z] = state.current, level = Math.hypot(x, y), all = Math.hypot(level, z);
    write("flow", all < 5e-4 ? "still" : `${all.toFixed(3)} m/s`);
    const angle = ((Math.atan2(y, x) * 180) / Math.PI + 360) % 360;
    write("bearing", level < 5e-4 ? "" : `${angle.toFixed(0)}° from x towards y`);
    if (!holding) lift.value = z;
    if (arrow?.of === state.current.join()) return;
    if (arrow) scene.remove(arrow.group);
    arrow = null;
    if (all < 5e-4) return;
    // Longer where it is faster, as far as that can be seen.
    const long = Math.min(1, Math.sqrt(all / FASTEST));
    arrow = makeCurrent({ fastest: all / long, velocity: packNow(state.current) }, 1, size);
    arrow.of = state.current.join();
    arrow.group.visible = byId("water").getAttribute("aria-pressed") === "true";
    scene.add(arrow.group);
  }

  function drawCompass() {
    const { context: c, w, h } = stage.pen("compass"), r = w / 2 - 11, mx = w / 2, my = h / 2;
    const fill = c.createRadialGradient(mx, my, 0, mx, my, r);
    fill.addColorStop(0, "rgba(120, 220, 230, 0.05)");
    fill.addColorStop(1, "rgba(120, 220, 230, 0.22)");
    c.fillStyle = fill;
    c.strokeStyle = "rgba(200, 240, 250, 0.35)";
    c.lineWidth = 1;
    for (const share of [1, 0.5]) {
      c.beginPath();
      c.arc(mx, my, r * share, 0, 2 * Math.PI);
      if (share === 1) c.fill();
      c.stroke();
    }
    for (let k = 0; k < 24; k++) {
      const a = (k * Math.PI) / 12, long = k % 6 ? 3 : 6;
      c.beginPath();
      c.moveTo(mx + r * Math.cos(a), my + r * Math.sin(a));
      c.lineTo(mx + (r - long) * Math.cos(a), my + (r - long) * Math.sin(a));
      c.stroke();
    }
    // Which way the camera looks.
    const a = Math.atan2(target.y - camera.position.y, target.x - camera.position.x);
    c.fillStyle = "rgba(235, 250, 252, 0.8)";
    c.beginPath();
    c.arc(mx + (r + 5) * Math.cos(a), my - (r + 5) * Math.sin(a), 2.5, 0, 2 * Math.PI);
    c.fill();
    c.fillStyle = "rgba(226, 244, 247, 0.72)";
    c.font = "10px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText("x", mx + r - 12, my - 7);
    c.fillText("y", mx + 8, my - r + 12);
    c.fillText(`${FASTEST}`, mx + 0.72 * r, my + 0.86 * r);
    const [x, y] = state.current, speed = Math.hypot(x, y), long = Math.min(1, speed / FASTEST) * r;
    c.strokeStyle = c.fillStyle = "#73ffd8";
    c.lineWidth = 3;
    c.lineCap = "round";
    if (long > 1) {
      const b = Math.atan2(y, x), [ex, ey] = [mx + long * Math.cos(b), my - long * Math.sin(b)], head = Math.min(9, long);
      c.beginPath();
      c.moveTo(mx, my);
      c.lineTo(mx + (long - head) * Math.cos(b), my - (long - head) * Math.sin(b));
      c.stroke();
      c.beginPath();
      c.moveTo(ex, ey);
      for (const side of [1, -1]) c.lineTo(ex - head * Math.cos(b + 0.45 * side), ey + head * Math.sin(b + 0.45 * side));
      c.fill();
    }
    c.beginPath();
    c.arc(mx, my, 3.5, 0, 2 * Math.PI);
    c.fill();
  }

  function drag(event) {
    const box = compass.getBoundingClientRect(), r = box.width / 2 - 11;
    let x = (event.clientX - box.left - box.width / 2) / r, y = -(event.clientY - box.top - box.height / 2) / r;
    const far = Math.hypot(x, y);
    if (far > 1) [x, y] = [x / far, y / far];
    if (far < 0.06) x = y = 0;
    flow([FASTEST * x, FASTEST * y, state.current[2]]);
  }
  compass.addEventListener("pointerdown", (event) => {
    holding = true;
    compass.setPointerCapture(event.pointerId);
    drag(event);
  });
  compass.addEventListener("pointermove", (event) => holding && drag(event));
  compass.addEventListener("pointerup", () => (holding = false));
  compass.addEventListener("pointercancel", () => (holding = false));
  compass.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-0.02, 0], ArrowRight: [0.02, 0], ArrowUp: [0, 0.02], ArrowDown: [0, -0.02] }[event.key];
    if (!by) return;
    const [x, y, z] = state.current;
    flow([x + by[0], y + by[1], z]);
    event.preventDefault();
    event.stopPropagation();
  });
  lift.addEventListener("input", () => flow([state.current[0], state.current[1], Number(lift.value)]));
  byId("still").addEventListener("click", () => flow([0, 0, 0]));
  byId("usual").addEventListener("click", () => flow([...data.current]));

  // ------------------------------------------------------------------ switches

  const rates = [0.05, 0.1, 0.25, 0.5, 1, 2, 4];
  for (const rate of rates) byId("rate").add(new Option(rate === 1 ? "real time" : `${rate}×`, rate));
  byId("rate").value = "1";
  const setRate = (factor) => ask({ do: "rate", factor });
  const nextRate = (by) => setRate(rates[Math.min(Math.max(rates.indexOf(state.rate) + by, 0), rates.length - 1)]);
  byId("rate").addEventListener("change", (event) => {
    setRate(Number(event.target.value));
    event.target.blur();
  });
  const pause = () => ask({ do: "pause", on: !state.paused });
  byId("play").addEventListener("click", pause);
  const reset = () => ask({ do: "reset" });
  byId("reset").addEventListener("click", reset);
  stock.addEventListener("change", () => stock.blur());
  const shown = {
    names: (on) => (chart.named = on),
    grid: (on) => (grid.visible = on),
    water: (on) => {
      surface.mesh.visible = dust.points.visible = on;
      if (arrow) arrow.group.visible = on;
    },
  };
  const toggle = stage.switches(shown);
  byId("grid").title = `level lines, ${gridStep} m apart (G)`;
  const toggleFollow = () => follow(state.followed === null ? (cast[0]?.key ?? null) : null);
  byId("follow").addEventListener("click", toggleFollow);
  const look = (view) => stage.look({ ...VIEWS[view], distance: state.followed === null ? 2 : 1.15 }, 90);
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => look(button.dataset.view));
  }
  const keys = {
    " ": pause,
    ArrowUp: () => nextRate(1),
    ArrowDown: () => nextRate(-1),
    "+": () => zoom(0.85),
    "-": () => zoom(1 / 0.85),
    "[": () => step(-1),
    "]": () => step(1),
    d: () => drop(),
    e: () => aim(!state.aiming),
    f: toggleFollow,
    n: () => toggle("names"),
    g: () => toggle("grid"),
    w: () => toggle("water"),
    R: reset,
    Delete: () => state.followed !== null && ask({ do: "remove", key: state.followed }),
    Escape: () => (state.aiming ? aim(false) : follow(null)),
  };
  ["swim", "side", "top", "below"].forEach((view, k) => (keys[k + 1] = () => look(view)));
  stage.listen(keys);

  // ------------------------------------------------------------------ frames

  const focus = new THREE.Vector3(), gap = new THREE.Vector3();
  let seconds = 0, told = 0;

  function moves(passed) {
    seconds = passed;
    if (state.clock === null) return !busy || shoal.there.size > 0;
    if (!state.paused) {
      // The clock follows the world's a little behind, without jumps.
      const aimed = state.newest - DELAY * Math.min(1, Math.max(state.rate, 0.2)) * (state.speed && state.speed < 0.9 * state.rate ? 2 : 1);
      const before = state.clock, pace = Math.min(state.rate, state.speed || state.rate);
      state.clock += passed * pace + (aimed - state.clock) * Math.min(1, 2.5 * passed);
      state.clock = Math.min(Math.max(state.clock, before), state.newest);
      const [x, y, z] = state.current, gone = state.clock - before;
      state.drift.x += x * gone;
      state.drift.y += y * gone;
      state.drift.z += z * gone;
      return true;
    }
    state.clock += (state.newest - state.clock) * Math.min(1, 4 * passed);
    return state.going || state.newest - state.clock > 1e-3 || [...shoal.there.values()].some((one) => one.leaving || one.seen < 1);
  }

  function update() {
    for (const swimmer of shoal.there.values()) {
      const now = poseAt(swimmer);
      if (now) swimmer.pose(now);
      else swimmer.seen = 0;
    }
    shoal.settle(seconds, state.followed);
    const swimmer = shoal.there.get(state.followed), there = swimmer?.times.length > 0;
    if (there && state.going) { // the camera glides there
      gap.subVectors(swimmer.place, target);
      const share = gap.length() < 0.02 * size ? 1 : Math.min(1, 4 * seconds + 0.02);
      focus.copy(target).addScaledVector(gap, share);
      if (share === 1) state.going = false;
    } else focus.copy(there ? swimmer.place : target);
    stage.place(state.clock ?? 0, focus, there);
    widen(stage, size, grid);
    dust.material.uniforms.uDrift.value.copy(state.drift);
    if (arrow) arrow.update(0, focus);
  }

  function tell() {
    write("time", state.clock === null ? "–" : `${state.clock.toFixed(1)} s`);
    if (performance.now() > told + 250) {
      told = performance.now();
      write("pace", state.paused ? "paused" : state.newest === null ? "–" : `${state.speed.toFixed(2)}×`);
      const slow = !state.paused && state.newest !== null && state.speed > 0 && state.speed < 0.85 * state.rate;
      byId("pace").style.color = slow ? "#ffb37a" : "";
      byId("pace").title = slow ? "this machine cannot step the world faster" : "";
      for (const [key, line] of lines) {
        const one = shoal.there.get(key);
        if (one?.times.length) line.children[2].textContent = `${speedOf(one).toFixed(2)} m/s`;
      }
    }
    const swimmer = shoal.there.get(state.followed);
    if (swimmer?.times.length) {
      write("age", `${Math.max(0, state.clock - swimmer.born).toFixed(0)} s`);
      write("speed", `${speedOf(swimmer).toFixed(3)} m/s`);
      write("depth", `${(world.surface - swimmer.place.z).toFixed(2)} m`);
      const [x, y, z] = swimmer.from, p = swimmer.place;
      write("way", `${Math.hypot(p.x - x, p.y - y, p.z - z).toFixed(2)} m`);
    }
    stage.drawAxes();
    drawCompass();
    const places = [...shoal.there.values()].map((one) => one.place), reach = 3 * size + 1;
    const low = [0, 1].map((k) => Math.min(target.getComponent(k), ...places.map((p) => p.getComponent(k))) - reach);
    const high = [0, 1].map((k) => Math.max(target.getComponent(k), ...places.map((p) => p.getComponent(k))) + reach);
    chart.drawMap(low, high, state.followed, drawWays);
    const marks = [];
    if (state.over) {
      const place = under(...state.over);
      if (place) marks.push({ place: place.toArray(), radius: 0.5 * size, color: "#ffb37a", name: "" });
    }
    chart.over(state.followed, marks);
    status.time = String(state.clock ?? "");
  }

  // Over ground, over the last second or so.
  function speedOf({ way }) {
    if (way.length < 2) return 0;
    const b = way[way.length - 1], a = way[Math.max(0, way.length - 5)];
    return Math.hypot(b[1] - a[1], b[2] - a[2], b[3] - a[3]) / Math.max(b[0] - a[0], 1e-6);
  }

  // The last two minutes of everybody, and the current.
  function drawWays(c, x, y) {
    c.lineWidth = 1.2;
    for (const { way, color } of shoal.there.values()) {
      c.strokeStyle = color;
      c.globalAlpha = 0.55;
      c.beginPath();
      for (const [, a, b] of way) c.lineTo(x(a), y(b));
      c.stroke();
    }
    c.globalAlpha = 1;
  }

  // ------------------------------------------------------------------ how to begin

  stage.resize();
  showFlow();
  showList();
  target.set(0, 0, world.surface - data.depth);
  look("swim");
  if (asked.has("plain")) document.body.classList.add("plain");
  status.ready = "true";
  stage.run({ moves, update, told: tell });
}

start();
