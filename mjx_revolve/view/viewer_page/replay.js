// The replay of an episode, or of a colony: an episode is a colony of one robot with forces besides.

// The poses of all robots, as `page_data.pack_poses` has packed them.
async function unpackPoses(data) {
  const packed = new Blob([bytesOf(data.poses)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const raw = await new Response(packed).arrayBuffer();
  const poses = data.rows.reduce((sum, n) => sum + n, 0), times = new Float32Array(raw, 0, poses);
  const count = (raw.byteLength - 4 * poses) / 2, bytes = new Uint8Array(raw, 4 * poses);
  const [places, turns, hinges] = data.steps;
  let at = 0, row = 0;
  return data.rows.map((n, k) => {
    const width = 7 + data.bodies[data.robots[k].body].tree.length - 1;
    const own = Array.from({ length: n }, () => new Float32Array(width));
    for (let c = 0; c < width; c++) {
      const step = c < 3 ? places : c < 7 ? turns : hinges, origin = c < 3 ? data.origins[k][c] : 0;
      for (let i = 0, whole = 0; i < n; i++, at++) {
        whole += ((bytes[at] | (bytes[count + at] << 8)) << 16) >> 16;
        own[i][c] = origin + whole * step;
      }
    }
    return new Poses(times.slice(row, (row += n)), own, data.leap ?? Infinity);
  });
}

// --------------------------------------------------------------------- what differs

// What an episode's page shows besides its robot: forces, current, target, speed and depth.
class EpisodeParts {
  constructor(page) {
    const { stage, data, size } = page, { episode, begin, world } = data, { step } = episode;
    const track = (packed, width = 3) => packed && new Track(packed, width, step);
    const [center, drift, target] = [episode.center, episode.drift, episode.target].map((packed) => track(packed));
    Object.assign(this, { page, stage, size, begin, world, center, drift, target, place: new THREE.Vector3() });
    this.speed = track(episode.speed, 1);
    this.deepest = episode.deepest;
    this.aim = episode.target_name;
    this.length = episode.length;
    this.speedName = episode.current ? "speed over ground" : "speed";
    page.heading = episode.heading;
    const [robot] = page.robots.there.values();
    if (episode.current) {
      page.arrow = makeCurrent(episode.current.velocity, (0.6 * size) / episode.current.fastest, step, size);
      stage.scene.add(page.arrow.group);
    }
    this.mark = target && makeTarget(size);
    if (target) stage.scene.add(this.mark.group);
    this.arrows = {};
    for (const name in episode.forces) {
      const kind = episode.forces[name];
      this.arrows[name] = makeArrows(kind, episode.anchors, robot, step, size);
      stage.scene.add(this.arrows[name].group);
      byId(name).disabled = kind.scale === 0;
      if (kind.scale === 0) byId(name).title = kind.why ?? `no ${name} in this episode`;
    }
    const most = this.speed.values.reduce((a, b) => Math.max(a, b), 1e-6), n = this.speed.count, points = [];
    for (let k = 0; k < n; k += Math.max(1, Math.floor(n / 500))) points.push([begin + k * step, this.speed.values[k]]);
    this.curve = { points, most, words: `speed, up to ${digits(most)} m/s` };
  }

  get switches() {
    return Object.fromEntries(Object.entries(this.arrows).map(([name, { group }]) => [name, (on) => (group.visible = on)]));
  }

  stretch(by) {
    for (const name in this.arrows) this.arrows[name].scale *= by;
    this.stage.draw();
  }

  driftAt(time, out) {
    return this.drift.vector(time - this.begin, 0, out);
  }

  placeOf = () => this.center.vector(this.page.time - this.begin, 0, this.place);

  update(time) {
    const t = time - this.begin, { arrow } = this.page;
    if (this.target) this.mark.update(this.target.vector(t, 0, this.place));
    if (arrow?.group.visible) arrow.update(t, this.placeOf());
    for (const name in this.arrows) if (this.arrows[name].group.visible) this.arrows[name].update(t);
  }

  show(time) {
    const { stage, page, world } = this, t = time - this.begin, [{ place }] = page.robots.there.values();
    const v = this.speed.at(t, 0, 1, [0])[0], depth = world.surface - place.z, [start] = page.actors[0].track.rows;
    const facts = {
      time: `${time.toFixed(2)} s`,
      [this.speedName]: {
        text: `${v.toFixed(3)} m/s`, more: `${(v / this.length).toFixed(2)} body lengths/s`,
        title: "over ground, mean over one stroke, or one second without strokes",
      },
      depth: { text: `${depth.toFixed(2)} m`, title: "of the core's centre below the still surface" },
      "from start": `${Math.hypot(place.x - start[0], place.y - start[1], place.z - start[2]).toFixed(2)} m`,
    };
    if (page.arrow) {
      const title = "of the water around the robot, over ground, waves apart; the arrow above the robot";
      facts.current = { text: `${page.arrow.speed(t).toFixed(3)} m/s`, title };
    }
    if (this.target) {
      const far = place.distanceTo(this.target.vector(t, 0, this.place));
      const title = `from the core to the ${this.aim}, the pink diamond`;
      facts[`to ${this.aim}`] = { text: `${far.toFixed(2)} m`, title };
    }
    page.tell(facts);
    stage.drawGauge(depth, this.deepest, world.surface - stage.bedAt(place.x, place.y));
    const pixels = stage.pixelsAt(stage.camera.position.distanceTo(stage.target));
    for (const [name, { scale }] of Object.entries(this.arrows)) {
      if (scale === 0) continue;
      const force = roundNumber((innerWidth > 760 ? 64 : 44) / (scale * pixels)), [, , bar, unit] = byId(name).children;
      bar.style.width = `${(force * scale * pixels).toFixed(1)}px`;
      unit.textContent = `${digits(force)} N`;
    }
  }
}

// What a colony's page shows besides its robots: the list, births and deaths, the map.
class ColonyParts {
  constructor(page) {
    const { data, actors, stage } = page;
    Object.assign(this, { page, data, stage, listed: "", written: 0 });
    this.births = actors.map(({ start }) => start).sort((a, b) => a - b);
    this.deaths = actors.map(({ end }) => end).filter(isFinite).sort((a, b) => a - b);
    const points = [[data.begin, 0]];
    for (const time of [...this.births, ...this.deaths, data.last].sort((a, b) => a - b)) {
      const t = Math.max(time, data.begin), before = points[points.length - 1][1];
      points.push([t, before], [t, countUpTo(this.births, t) - countUpTo(this.deaths, t)]);
    }
    const most = points.reduce((a, [, n]) => Math.max(a, n), 1);
    this.curve = { points, most, words: `alive, up to ${most}` };
  }

  switches = {};

  driftAt(time, out) {
    return out.fromArray(this.data.current).multiplyScalar(time);
  }

  update() {}

  // Lists the robots that are alive.
  cast() {
    const { page } = this, alive = page.actors.filter((actor) => page.lives(actor)), text = alive.map(({ key }) => key).join();
    if (text === this.listed) return;
    this.listed = text;
    page.list(alive);
    byId("count").textContent = alive.length;
  }

  show(time) {
    const { page, data } = this, born = countUpTo(this.births, time), gone = countUpTo(this.deaths, time);
    page.tell({
      time: page.clock(time), alive: String(born - gone),
      born: { text: String(born), title: "born so far, those at the beginning among them" },
      gone: { text: String(gone), title: "how many have vanished so far" },
    });
    if (performance.now() > this.written + 200) this.describe(time);
    page.overlay.drawMap(data.low, data.high, page.followed, (c, x, y, scale) => {
      c.strokeStyle = PLACE;
      for (const { place, radius } of data.marks) {
        c.beginPath();
        c.arc(x(place[0]), y(place[1]), radius * scale, 0, 2 * Math.PI);
        c.stroke();
      }
    });
    page.overlay.draw(page.followed, data.marks);
  }

  // What is known of the robot that is followed.
  describe(time) {
    this.written = performance.now();
    const { page } = this, actor = page.actors[page.followed], robot = page.robots.there.get(page.followed);
    if (!actor) return page.describe(null);
    const { track, start, end, info } = actor, speed = track.speed(time - 0.5, time + 0.5);
    const facts = { // before its birth and after its death it is nowhere
      born: page.clock(start), depth: robot ? `${(page.world.surface - robot.place.z).toFixed(2)} m` : "–",
      speed: robot && isFinite(speed) ? `${speed.toFixed(3)} m/s` : "–", ...info,
    };
    if (isFinite(end)) facts.gone = page.clock(end);
    return page.describe(actor, facts);
  }
}

// --------------------------------------------------------------------- the page

class Replay extends Page {
  constructor(stage, data, tracks) {
    super(stage, data, data.shapes);
    const { begin, last, episode } = data;
    Object.assign(this, { begin, last, length: last - begin, time: begin, rate: 1, on: true, trail: null });
    this.actors = data.robots.map((robot, k) => ({
      ...robot, key: k, end: robot.end ?? Infinity, color: colorOf(k), track: tracks[k],
    }));
    const reach = Math.max(...[0, 1].map((k) => data.high[k] - data.low[k]), 4 * this.size);
    stage.controls.maxDistance = Math.max(60 * this.size, 2 * reach);
    this.seek(begin);
    this.parts = episode ? new EpisodeParts(this) : new ColonyParts(this);
    this.layCurve(this.parts.curve);
    this.switches({ trail: (on) => this.trail && (this.trail.group.visible = on), ...this.parts.switches });
    const rates = [0.25, 0.5, 1, 2, 4, 10, 30, 100, 300, 1000].filter((x) => x <= Math.max(4, this.length / 10));
    const nudge = (by, far) => this.seek(this.time + by * (far ? (episode ? 1 : 0.05 * this.length) : episode ? 0.1 : this.rate));
    this.listen({ play: () => this.play(!this.on) }, {
      ArrowLeft: ({ shiftKey }) => nudge(-1, shiftKey),
      ArrowRight: ({ shiftKey }) => nudge(1, shiftKey),
      Home: () => this.seek(begin),
      End: () => (this.play(false), this.seek(last)), // or it would begin again at once
      ...(episode && { "[": () => this.parts.stretch(1 / 1.25), "]": () => this.parts.stretch(1.25) }),
    }, rates);
    const scrub = byId("scrub");
    Object.assign(scrub, { min: begin, max: last, step: Math.min(0.005, this.length / 1000) || 1 });
    scrub.addEventListener("input", () => this.seek(Number(scrub.value)));
    this.open(rates);
  }

  // As the address says.
  open(rates) {
    const { options, stage, data, actors } = this;
    const number = (name, usual) => (options.get(name) && isFinite(options.get(name)) ? Number(options.get(name)) : usual);
    stage.resize();
    this.seek(number("t", this.begin));
    this.setRate(rates.includes(number("rate", 1)) ? number("rate", 1) : 1);
    stage.target.fromArray(data.low).add({ x: data.high[0], y: data.high[1], z: data.high[2] }).multiplyScalar(0.5);
    const key = number("follow", data.many ? -1 : 0), view = VIEWS[options.get("view")];
    this.follow(key in actors ? key : null);
    const robot = this.robots.there.get(this.followed);
    if (robot) stage.target.copy(this.parts.placeOf?.() ?? robot.place);
    if (data.many && !robot && !view) this.all();
    else {
      const { azimuth, elevation } = view ?? VIEWS.swim, distance = number("distance", robot ? 1 : 2.1);
      this.look({ azimuth: number("azimuth", azimuth), elevation: number("elevation", elevation), distance });
    }
    for (const [list, on] of [["show", true], ["hide", false]]) {
      for (const name of (options.get(list) ?? "").split(",")) {
        if (name in this.shown) this.toggle(name, on);
        else if (name === "follow" && !on) this.follow(null);
      }
    }
    this.play(!options.has("paused") && !matchMedia("(prefers-reduced-motion: reduce)").matches);
  }

  // ------------------------------------------------------------------ time

  seek(time) {
    this.time = Math.min(Math.max(time, this.begin), this.last);
    this.cast(true);
    this.stage.draw();
  }

  play(on) {
    if (on && this.time >= this.last) this.seek(this.begin);
    this.on = status.playing = on;
    this.playing(on, on ? "pause" : "play");
  }

  setRate(rate) {
    this.rate = rate;
    byId("rate").value = String(rate);
  }

  clock(time) {
    const s = Math.max(0, time), two = (x) => String(Math.floor(x)).padStart(2, "0");
    if (this.length < 120) return `${s.toFixed(1)} s`;
    return this.length < 3600 ? `${two(s / 60)}:${two(s % 60)}` : `${Math.floor(s / 3600)}:${two((s / 60) % 60)}:${two(s % 60)}`;
  }

  // ------------------------------------------------------------------ robots

  lives({ start, end }) {
    return start <= this.time && this.time < end;
  }

  // Robots appear and vanish; at once, without fading, after a jump in time.
  cast(atOnce = false) {
    for (const actor of this.actors) {
      const here = this.lives(actor), robot = this.robots.there.get(actor.key);
      if (here && !robot) {
        const body = this.robots.bodyOf(actor.body, this.data.bodies[actor.body]);
        this.robots.add(actor.key, body, { name: actor.name, color: actor.color, seen: atOnce ? 1 : 0 });
      } else if (robot) robot.leaving = !here;
      if (robot && !here && atOnce) this.robots.remove(actor.key);
    }
    for (const robot of this.robots.there.values()) robot.pose(this.actors[robot.key].track.at(this.time));
    this.robots.tidy(200);
    this.parts?.cast?.();
    status.alive = this.robots.living.length;
  }

  follow(key) {
    super.follow(key);
    if (this.trail) {
      this.stage.scene.remove(this.trail.group);
      release(this.trail.group);
    }
    const actor = this.actors[key ?? (this.data.many ? null : 0)];
    this.trail = actor ? actor.track.trail() : null;
    this.parts.written = 0;
    if (!actor) return;
    this.stage.scene.add(this.trail.group);
    this.trail.group.visible = this.isOn("trail");
  }

  // ------------------------------------------------------------------ frames

  moves(passed) {
    if (this.on) {
      this.time += passed * this.rate;
      if (this.time > this.last) this.seek(this.begin); // over again
    }
    return this.on || this.gliding || this.robots.fading;
  }

  update(seconds) {
    const { time, parts } = this;
    this.cast();
    this.robots.settle(seconds, this.data.many ? this.followed : null);
    this.aim(time, seconds, parts.placeOf);
    parts.update(time);
    parts.driftAt(time, this.stage.dust.material.uniforms.uDrift.value);
    this.trail?.show(time - this.trail.from);
  }

  show() {
    this.parts.show(this.time);
    byId("clock").textContent = `${this.clock(this.time)} / ${this.clock(this.last)}`;
    byId("scrub").value = this.time;
    this.showCurve();
    this.stage.drawAxes();
    status.time = this.time.toFixed(4);
  }

  // Draws the curve below the time bar: points are [time, value], rising.
  layCurve({ points, most, words }) {
    const at = ([time, value]) => `${this.share(time)} ${37 - (31 * value) / most}`, [end] = points[points.length - 1];
    const d = `M0 40L${points.map(at).join("L")}L${this.share(end)} 40Z`;
    for (const path of byId("chart").querySelectorAll("path")) set(path, { d });
    byId("curve").textContent = words;
  }

  // Where a time is along the time bar, from 0 to 1.
  share(time) {
    return (Math.min(Math.max(time, this.begin), this.last) - this.begin) / Math.max(this.length, 1e-9);
  }

  showCurve() {
    const now = this.share(this.time), life = this.data.many && this.actors[this.followed];
    set(byId("past"), { width: now });
    set(byId("now"), { x1: now, x2: now });
    const x = life ? this.share(life.start) : 0, width = life ? Math.max(0.003, this.share(life.end) - x) : 0;
    set(byId("life"), { x, width, fill: life ? life.color : "none" });
  }
}

openPage(async (stage, data) => new Replay(stage, data, await unpackPoses(data)));
