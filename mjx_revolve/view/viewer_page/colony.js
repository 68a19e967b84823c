// A colony's page: unpacks the poses, draws who lives at a time, and listens.

// Poses as `colony.pack_poses` has packed them: for each actor times [T] and rows [T, width].
async function unpackPoses(data) {
  const packed = new Blob([bytesOf(data.poses)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const raw = await new Response(packed).arrayBuffer();
  const poses = data.rows.reduce((sum, n) => sum + n, 0), times = new Float32Array(raw, 0, poses);
  const count = (raw.byteLength - 4 * poses) / 2, bytes = new Uint8Array(raw, 4 * poses);
  const [places, turns, hinges] = data.steps;
  let at = 0, row = 0;
  return data.rows.map((n, k) => {
    const width = 7 + data.bodies[data.actors[k].body].tree.length - 1, values = new Float32Array(n * width);
    for (let c = 0; c < width; c++) {
      const step = c < 3 ? places : c < 7 ? turns : hinges, origin = c < 3 ? data.origins[k][c] : 0;
      for (let i = 0, whole = 0; i < n; i++, at++) {
        whole += ((bytes[at] | (bytes[count + at] << 8)) << 16) >> 16;
        values[i * width + c] = origin + whole * step;
      }
    }
    const time = times.slice(row, (row += n));
    return { time, values, width, row: 0 };
  });
}

async function start() {
  const data = JSON.parse(byId("episode").textContent), size = data.length, { world, begin, last } = data;
  const asked = new URLSearchParams(location.hash.slice(1));
  const stage = openStage(world, size);
  if (stage === null) return;
  const { scene, target, dust, surface, draw, zoom, write, controls } = stage;
  let tracks;
  try {
    tracks = await unpackPoses(data);
  } catch (error) {
    fail(`This page's poses could not be unpacked: ${error}`);
    return;
  }
  const shoal = new Shoal(stage, data.shapes), chart = new Chart(stage, shoal);
  const gridStep = roundNumber(Math.max(0.6 * size, 0.5));
  const grid = makeGrid(data.floor, 4 * size, gridStep, world.bed === null);
  scene.add(grid);
  const actors = data.actors.map((actor, k) => ({
    ...actor, key: k, end: actor.end ?? Infinity, track: tracks[k], color: chipOf(k),
  }));
  const byBirth = actors.map((actor) => actor.start).sort((a, b) => a - b);
  const byDeath = actors.map((actor) => actor.end).filter(isFinite).sort((a, b) => a - b);
  const reach = Math.max(...[0, 1].map((k) => data.high[k] - data.low[k]), 4 * size);
  controls.maxDistance = Math.max(60 * size, 2 * reach);

  // ------------------------------------------------------------------ poses

  const length = last - begin, pose = [];

  // The row at or before a time; looked for from where it was last.
  function rowAt(track, time) {
    const { time: t } = track;
    let low = track.row;
    if (t[low] > time || (low + 8 < t.length && t[low + 8] <= time)) {
      let high = t.length - 1;
      low = 0;
      while (low < high) {
        const middle = (low + high + 1) >> 1;
        if (t[middle] <= time) low = middle;
        else high = middle - 1;
      }
    } else while (low + 1 < t.length && t[low + 1] <= time) low++;
    return (track.row = low);
  }

  // Whether somebody was put elsewhere between a row and the next, as beyond the edge of an arena.
  function leaps(v, a, width) {
    const far = (k) => v[a + width + k] - v[a + k];
    return data.leap !== null && Math.hypot(far(0), far(1), far(2)) > data.leap;
  }

  // Between poses places go along a curve, as what swims does; all else goes straight.
  function poseAt(track, time) {
    const { time: t, values: v, width } = track, i = rowAt(track, time);
    if (i + 1 >= t.length || time <= t[i]) return mixPoses(v, i * width, v, i * width, 0, width, pose);
    const span = t[i + 1] - t[i], share = (time - t[i]) / span, a = i * width, b = a + width;
    if (leaps(v, a, width)) return mixPoses(v, a, v, a, 0, width, pose);
    mixPoses(v, a, v, b, share, width, pose);
    if (i > 0 && i + 2 < t.length && !leaps(v, a - width, width) && !leaps(v, b, width)) {
      const s2 = share * share, s3 = s2 * share;
      const before = span / (t[i + 1] - t[i - 1]), after = span / (t[i + 2] - t[i]);
      for (let k = 0; k < 3; k++) {
        const m = (v[b + k] - v[a - width + k]) * before, n = (v[b + width + k] - v[a + k]) * after;
        pose[k] = (2 * s3 - 3 * s2 + 1) * v[a + k] + (s3 - 2 * s2 + share) * m
          + (3 * s2 - 2 * s3) * v[b + k] + (s3 - s2) * n;
      }
    }
    return pose;
  }

  // ------------------------------------------------------------------ time

  const state = { time: begin, playing: true, rate: 1, followed: null, going: false };
  const rates = [0.25, 0.5, 1, 2, 5, 10, 30, 100, 300, 1000].filter((x) => x <= Math.max(4, length / 10));
  for (const rate of rates) byId("rate").add(new Option(`${rate}×`, rate));

  function seek(time) {
    state.time = Math.min(Math.max(time, begin), last);
    cast(true);
    draw();
  }

  function play(on) {
    if (on && state.time >= last) seek(begin);
    state.playing = on;
    byId("play").setAttribute("aria-label", on ? "pause" : "play");
    byId("play").classList.toggle("playing", on);
    status.playing = on;
    draw();
  }

  function setRate(rate) {
    state.rate = rate;
    byId("rate").value = String(rate);
  }

  function clockOf(time) {
    const s = Math.max(0, time), two = (x) => String(Math.floor(x)).padStart(2, "0");
    if (length < 120) return `${s.toFixed(1)} s`;
    return length < 3600 ? `${two(s / 60)}:${two(s % 60)}` : `${Math.floor(s / 3600)}:${two((s / 60) % 60)}:${two(s % 60)}`;
  }

  // ------------------------------------------------------------------ who is there

  let listed = "";

  // At once: without fading, as after a jump in time.
  function cast(atOnce = false) {
    const alive = [];
    for (const actor of actors) {
      const here = actor.start <= state.time && state.time < actor.end;
      const swimmer = shoal.there.get(actor.key);
      if (here) alive.push(actor);
      if (here && !swimmer) {
        const body = shoal.bodyOf(actor.body, data.bodies[actor.body]);
        shoal.add(actor.key, body, actor.name, actor.color).seen = atOnce ? 1 : 0;
      } else if (swimmer) swimmer.leaving = !here;
      if (swimmer && !here && atOnce) shoal.remove(actor.key);
    }
    shoal.tidy(200);
    const text = alive.map((actor) => actor.key).join();
    if (text !== listed) {
      listed = text;
      byId("list").replaceChildren(...alive.map(lineOf));
      byId("count").textContent = alive.length;
    }
    status.alive = alive.length;
  }

  const lines = new Map();

  function lineOf(actor) {
    if (!lines.has(actor.key)) {
      const line = document.createElement("li");
      line.setAttribute("role", "option");
      line.innerHTML = "<i></i><b></b><em></em>";
      line.children[0].style.background = actor.color;
      line.children[1].textContent = actor.name;
      line.addEventListener("click", () => follow(actor.key === state.followed ? null : actor.key));
      line.addEventListener("pointerenter", () => point(actor.key));
      line.addEventListener("pointerleave", () => point(null));
      lines.set(actor.key, line);
    }
    const line = lines.get(actor.key);
    line.setAttribute("aria-selected", actor.key === state.followed);
    return line;
  }

  function point(key) {
    shoal.pointed = key;
    draw();
  }

  let trail = null;

  function follow(key) {
    lines.get(state.followed)?.setAttribute("aria-selected", false);
    state.followed = key;
    state.going = key !== null; // the camera still has a way to go
    lines.get(key)?.setAttribute("aria-selected", true);
    lines.get(key)?.scrollIntoView({ block: "nearest" });
    byId("follow").setAttribute("aria-pressed", key !== null);
    byId("who").hidden = key === null;
    if (trail) {
      scene.remove(trail.mesh);
      trail.mesh.geometry.dispose();
      trail = null;
    }
    status.followed = key ?? "";
    draw();
    if (key === null) return;
    const actor = actors[key], [mark, name] = byId("who").firstChild.children, rows = byId("who").lastChild;
    mark.style.background = actor.color;
    name.textContent = actor.name;
    const facts = { born: clockOf(actor.start), speed: "", depth: "", ...actor.info };
    if (isFinite(actor.end)) facts.gone = clockOf(actor.end);
    rows.replaceChildren(...Object.entries(facts).map(([key, value]) => {
      const fact = document.createElement("div"), [dt, dd] = ["dt", "dd"].map((tag) => fact.appendChild(document.createElement(tag)));
      dt.textContent = key;
      dd.textContent = value;
      dd.dataset.fact = key;
      return fact;
    }));
    trail = trailOf(actor);
    scene.add(trail.mesh);
    stage.resized();
    trail.mesh.visible = byId("trail").getAttribute("aria-pressed") === "true";
  }

  // The way of an actor, at most so many points of it.
  function trailOf(actor) {
    const { time, values, width } = actor.track, from = time[0], span = Math.max(time[time.length - 1] - from, 1e-6);
    const count = Math.min(Math.max(2, 4 * time.length), 4000), path = new Float32Array(3 * count);
    for (let k = 0; k < count; k++) {
      const p = poseAt(actor.track, from + (span * k) / (count - 1));
      path.set([p[0], p[1], p[2]], 3 * k);
    }
    return { ...makeTrail({ values: path, count }, { step: span / (count - 1) }, data.leap ?? Infinity), from };
  }

  // ------------------------------------------------------------------ switches

  const shown = {
    trail: (on) => trail && (trail.mesh.visible = on),
    names: (on) => (chart.named = on),
    grid: (on) => (grid.visible = on),
    water: (on) => (surface.mesh.visible = dust.points.visible = on),
  };
  const toggle = stage.switches(shown);
  byId("grid").title = `level lines, ${gridStep} m apart (G)`;
  const living = () => [...shoal.there.values()].filter((swimmer) => !swimmer.leaving);
  const toggleFollow = () => follow(state.followed === null ? (living()[0]?.key ?? null) : null);
  byId("follow").addEventListener("click", toggleFollow);
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("rate").addEventListener("change", (event) => {
    setRate(Number(event.target.value));
    event.target.blur();
  });
  const scrub = byId("scrub");
  Object.assign(scrub, { min: begin, max: last, step: Math.min(0.05, length / 1000) || 1 });
  scrub.addEventListener("input", () => seek(Number(scrub.value)));

  function look(view) {
    stage.look({ ...VIEWS[view], distance: state.followed === null ? 2.2 : 1 }, 90);
  }

  // Everybody at once, from above and beside.
  function all() {
    follow(null);
    const there = living().map((swimmer) => swimmer.place);
    if (!there.length) return;
    const low = there[0].clone(), high = there[0].clone();
    for (const p of there) low.min(p), high.max(p);
    target.copy(low).add(high).multiplyScalar(0.5);
    const wide = Math.max(high.distanceTo(low), 2 * size) / size;
    stage.look({ azimuth: 118, elevation: 34, distance: Math.max(0.47 * wide, 1.6) }, 90);
  }
  byId("all").addEventListener("click", all);
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => look(button.dataset.view));
  }

  // The next one in the list, or the one before.
  function step(by) {
    const keys = living().map((swimmer) => swimmer.key).sort((a, b) => a - b);
    if (keys.length) follow(keys[(keys.indexOf(state.followed) + by + keys.length) % keys.length]);
  }

  const nextRate = (by) => setRate(rates[Math.min(Math.max(rates.indexOf(state.rate) + by, 0), rates.length - 1)]);
  const keys = {
    " ": () => play(!state.playing),
    ArrowLeft: (event) => seek(state.time - (event.shiftKey ? 0.05 * length : state.rate)),
    ArrowRight: (event) => seek(state.time + (event.shiftKey ? 0.05 * length : state.rate)),
    ArrowUp: () => nextRate(1),
    ArrowDown: () => nextRate(-1),
    Home: () => seek(begin),
    End: () => seek(last),
    Escape: () => follow(null),
    "+": () => zoom(0.85),
    "-": () => zoom(1 / 0.85),
    "[": () => step(-1),
    "]": () => step(1),
    a: all,
    f: toggleFollow,
    t: () => toggle("trail"),
    n: () => toggle("names"),
    g: () => toggle("grid"),
    w: () => toggle("water"),
  };
  ["swim", "side", "top", "below"].forEach((view, k) => (keys[k + 1] = () => look(view)));
  stage.listen(keys);
  const canvas = byId("view");
  onClick(canvas, (x, y) => {
    const key = shoal.pick(x, y);
    if (key !== null) follow(key);
  });
  canvas.addEventListener("pointermove", (event) => {
    const key = event.buttons ? null : shoal.pick(event.clientX, event.clientY);
    canvas.style.cursor = key === null ? "" : "pointer";
    if (key !== shoal.pointed) point(key);
  });
  byId("map").addEventListener("click", (event) => {
    const { key, place } = chart.onMap(event);
    if (key !== null) follow(key);
    else {
      follow(null);
      moveTo(new THREE.Vector3(...place, target.z));
    }
  });

  function moveTo(place) {
    stage.camera.position.add(place).sub(target);
    target.copy(place);
    draw();
  }

  // ------------------------------------------------------------------ instruments

  const changes = [...byBirth.map((t) => [t, 1]), ...byDeath.map((t) => [t, -1])].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const curve = [];
  let alive = 0, most = 1;
  for (const [t, by] of changes) {
    alive += by;
    curve.push([t, alive]);
    most = Math.max(most, alive);
  }
  const before = (sorted, time) => {
    let low = 0, high = sorted.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (sorted[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  };

  function drawCurve() {
    const { context: c, w, h } = stage.pen("chart"), pad = 8, span = w - 2 * pad;
    const x = (time) => pad + ((time - begin) / Math.max(length, 1e-9)) * span, y = (n) => h - 3 - (n / most) * (h - 9);
    const area = (until) => {
      c.beginPath();
      c.moveTo(x(begin), h);
      let n = 0;
      for (const [t, count] of curve) {
        if (t > until) break;
        c.lineTo(x(Math.max(t, begin)), y(n));
        c.lineTo(x(Math.max(t, begin)), y((n = count)));
      }
      c.lineTo(x(until), y(n));
      c.lineTo(x(until), h);
      c.fill();
    };
    c.fillStyle = "rgba(190, 235, 240, 0.22)";
    area(last);
    c.fillStyle = "rgba(255, 140, 60, 0.75)";
    area(state.time);
    if (state.followed !== null) { // its life
      const { start, end, color } = actors[state.followed];
      c.fillStyle = color;
      c.fillRect(x(Math.max(start, begin)), h - 3, Math.max(2, x(Math.min(end, last)) - x(Math.max(start, begin))), 3);
    }
    c.fillStyle = "#fff";
    c.fillRect(x(state.time) - 1, 0, 2, h);
    c.fillStyle = "rgba(235, 250, 252, 0.8)";
    c.textAlign = "right";
    c.textBaseline = "top";
    c.fillText(`alive, up to ${most}`, w - pad - 4, 2);
  }

  stage.resized = () => trail?.material.uniforms.uScreen.value.set(innerWidth / 2, innerHeight / 2);
  let told = 0;

  function tell() {
    const { time } = state, born = before(byBirth, time), gone = before(byDeath, time);
    write("time", clockOf(time));
    write("alive", String(born - gone));
    write("born", String(born));
    write("gone", String(gone));
    byId("clock").textContent = `${clockOf(time)} / ${clockOf(last)}`;
    scrub.value = time;
    const swimmer = shoal.there.get(state.followed), fact = (name) => byId("who").querySelector(`[data-fact=${name}]`);
    if (swimmer && performance.now() > told + 200) {
      told = performance.now();
      const { track } = actors[state.followed], t = track.time;
      const [a, b] = [Math.max(time - 0.5, t[0]), Math.min(time + 0.5, t[t.length - 1])];
      const from = poseAt(track, a).slice(0, 3), to = poseAt(track, b).slice(0, 3);
      const way = Math.hypot(...from.map((p, k) => to[k] - p));
      fact("speed").textContent = b > a && way < (data.leap ?? Infinity) ? `${(way / (b - a)).toFixed(3)} m/s` : "–";
      fact("depth").textContent = `${(world.surface - swimmer.place.z).toFixed(2)} m`;
    }
    drawCurve();
    stage.drawAxes();
    chart.drawMap(data.low, data.high, state.followed, (c, x, y, scale) => {
      c.strokeStyle = "rgba(255, 170, 210, 0.8)";
      for (const mark of data.marks) {
        c.beginPath();
        c.arc(x(mark.place[0]), y(mark.place[1]), mark.radius * scale, 0, 2 * Math.PI);
        c.stroke();
      }
    });
    chart.over(state.followed, data.marks);
    status.time = time.toFixed(4);
  }

  // ------------------------------------------------------------------ frames

  const focus = new THREE.Vector3(), gap = new THREE.Vector3();
  let seconds = 0, fading = true;

  function moves(passed) {
    seconds = passed;
    if (state.playing) {
      state.time += passed * state.rate;
      if (state.time > last) seek(begin); // over again
    }
    return state.playing || fading || state.going;
  }

  function update() {
    cast();
    for (const swimmer of shoal.there.values()) {
      swimmer.pose(poseAt(actors[swimmer.key].track, state.time));
    }
    shoal.settle(seconds, state.followed);
    fading = living().some((swimmer) => swimmer.seen < 1) || living().length < shoal.there.size;
    const swimmer = shoal.there.get(state.followed);
    if (state.followed !== null && (!swimmer || swimmer.leaving)) state.going = false;
    else if (swimmer && state.going) { // the camera glides there
      gap.subVectors(swimmer.place, target);
      const share = gap.length() < 0.02 * size ? 1 : Math.min(1, 5 * seconds + 0.02);
      focus.copy(target).addScaledVector(gap, share);
      if (share === 1) state.going = false;
    } else focus.copy(swimmer && !swimmer.leaving ? swimmer.place : target);
    const going = swimmer && !swimmer.leaving;
    stage.place(state.time, focus, going);
    widen(stage, size, grid);
    dust.material.uniforms.uDrift.value.fromArray(data.current).multiplyScalar(state.time);
    if (trail) trail.material.uniforms.uNow.value = state.time - trail.from;
  }

  // ------------------------------------------------------------------ how to begin

  stage.resize();
  const number = (name, usual) => (asked.has(name) && asked.get(name) !== "" ? Number(asked.get(name)) : usual);
  seek(number("t", begin));
  setRate(rates.includes(number("rate", 1)) ? number("rate", 1) : 1);
  for (const name of (asked.get("show") || "").split(",")) if (name in shown) toggle(name, true);
  for (const name of (asked.get("hide") || "").split(",")) if (name in shown) toggle(name, false);
  for (const swimmer of shoal.there.values()) swimmer.pose(poseAt(actors[swimmer.key].track, state.time));
  target.set(...[0, 1, 2].map((k) => (data.low[k] + data.high[k]) / 2));
  all();
  if (asked.has("follow")) {
    const key = number("follow", 0);
    target.copy(shoal.there.get(key)?.place ?? target);
    follow(key in actors ? key : null);
    look(asked.get("view") in VIEWS ? asked.get("view") : "swim");
  }
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  play(!asked.has("paused") && !calm);
  if (asked.has("plain")) document.body.classList.add("plain");
  status.ready = "true";
  stage.run({ moves, update, told: tell });
}

start();
