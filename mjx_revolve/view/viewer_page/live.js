// A running world: listens to its events, draws it, and posts the user's commands.

const DELAY = 0.16; // s of real time behind the world, so that there is always a pose to go to
const FASTEST = 0.5; // m/s at the compass's rim

class Live extends Page {
  constructor(stage, data) {
    super(stage, data, {});
    Object.assign(this, {
      clock: null, newest: null, paused: false, rate: 1, speed: 0, flow: data.current, drift: new THREE.Vector3(),
      cast: [], bodies: {}, wanted: null, // a robot to follow once it is there
      aiming: false, over: null, written: 0, busy: true, fresh: true,
    });
    stage.controls.maxDistance = 120 * this.size;
    this.switches();
    this.command();
    this.compass();
    this.hear();
    stage.resize();
    this.setFlow(this.flow);
    this.showCast([]);
    stage.target.set(0, 0, this.world.surface - data.depth);
    this.look(VIEWS.swim);
  }

  // ------------------------------------------------------------------ commands

  say(text, bad = false) {
    const note = byId("note");
    note.textContent = status.note = text;
    note.classList.toggle("bad", bad);
    note.hidden = false;
    clearTimeout(this.noteTimer);
    this.noteTimer = setTimeout(() => (note.hidden = true), bad ? 6000 : 3500);
  }

  async ask(what) {
    try {
      const answer = await fetch("command", {
        method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(what),
      });
      const result = await answer.json();
      if (!answer.ok) this.say(result.error, true);
      return result;
    } catch {
      this.say("The world does not answer.", true);
      return {};
    }
  }

  setRate(factor) {
    this.ask({ do: "rate", factor });
  }

  command() {
    const { data } = this, catalogue = byId("catalogue"), deep = byId("deep");
    catalogue.addEventListener("change", () => catalogue.blur());
    const showDepth = () => (byId("deepness").textContent = `${Number(deep.value).toFixed(2)} m`);
    deep.addEventListener("input", showDepth);
    showDepth();
    const acts = {
      drop: () => this.drop(),
      aim: () => this.setAim(!this.aiming),
      play: () => this.ask({ do: "pause", on: !this.paused }),
      reset: () => this.ask({ do: "reset" }),
      still: () => this.pour([0, 0, 0]),
      usual: () => this.pour([...data.current]),
    };
    this.listen(acts, {
      Delete: () => this.followed !== null && this.ask({ do: "remove", key: this.followed }),
      Escape: () => (this.aiming ? this.setAim(false) : this.follow(null)),
    }, [0.05, 0.1, 0.25, 0.5, 1, 2, 4]);
    byId("rate").value = "1";
    byId("view").addEventListener("dblclick", ({ clientX: x, clientY: y }) => {
      if (this.robots.pick(x, y) === null) this.dropUnder(x, y);
    });
  }

  // Near the middle, or at a place [x, y].
  async drop(place = null) {
    const what = { do: "drop", entry: Number(byId("catalogue").value), depth: Number(byId("deep").value) };
    if (place) what.place = place.map((x) => Math.min(500, Math.max(-500, Number(x.toFixed(3)))));
    const { key, later } = await this.ask(what);
    if (later) this.say("compiling: the robot comes in a moment");
    if (place || key === undefined || key === null) return;
    if (this.robots.there.has(key)) this.follow(key);
    else this.wanted = key;
  }

  // The place below a place on the screen at which a robot would be dropped.
  under(x, y) {
    return this.stage.onPlane(x, y, this.world.surface - Number(byId("deep").value));
  }

  dropUnder(x, y) {
    const place = this.under(x, y);
    if (place === null) this.say("That is the horizon: click further down.", true);
    else this.drop([place.x, place.y]);
  }

  setAim(on) {
    this.aiming = on;
    this.over = null;
    byId("aim").setAttribute("aria-pressed", on);
    document.body.classList.toggle("aiming", on);
    this.stage.draw();
  }

  clicked(x, y, event) {
    if (!this.aiming) return super.clicked(x, y);
    this.dropUnder(x, y);
    if (!event.shiftKey) this.setAim(false);
  }

  hovered(event) {
    if (!this.aiming) return super.hovered(event);
    this.over = [event.clientX, event.clientY];
    this.stage.draw();
  }

  onMap(at) {
    if (!this.aiming) return super.onMap(at);
    this.drop(at.place);
    this.setAim(false);
  }

  // ------------------------------------------------------------------ events

  wait(text) {
    this.busy = status.busy = text !== null;
    byId("busy").hidden = !this.busy;
    if (this.busy) byId("busy").lastChild.textContent = text;
    this.stage.draw();
  }

  hear() {
    const events = new EventSource("events");
    events.addEventListener("open", () => this.wait("waiting for the water…"));
    events.addEventListener("error", () => this.wait("no connection: has the command ended?"));
    const acts = {
      note: (text) => this.say(text, true),
      state: (now) => this.takeState(now),
      bodies: (bodies) => bodies.forEach((body) => {
        Object.assign(this.robots.packed, body.shapes);
        this.bodies[body.number] = body;
      }),
      cast: (now) => this.showCast(now),
      poses: (now) => this.takePoses(now),
    };
    for (const name in acts) events.addEventListener(name, ({ data }) => acts[name](JSON.parse(data)));
  }

  takeState({ paused, rate, speed, current, busy }) {
    Object.assign(this, { paused, rate, speed });
    this.playing(!paused, paused ? "go on" : "pause");
    byId("rate").value = String(rate);
    if (busy) this.wait(`compiling… ${busy.toFixed(0)} s`);
    else if (this.newest !== null || paused) this.wait(null);
    status.paused = paused;
    status.current = current.join();
    if (!this.holding && !this.sending) this.setFlow(current); // what the user drags, or has asked for, is newer
  }

  showCast(now) {
    this.cast = now.map((robot) => ({ ...robot, color: colorOf(robot.key) }));
    const keys = new Set(now.map(({ key }) => key));
    for (const robot of this.robots.there.values()) if (!keys.has(robot.key)) robot.leaving = true;
    if (this.followed !== null && !keys.has(this.followed)) this.follow(null);
    for (const robot of this.cast) if (!this.robots.there.has(robot.key)) this.admit(robot);
    this.list(this.cast, (line, { key, name }) => {
      const out = line.lastElementChild;
      out.title = out.ariaLabel = `take ${name} out`;
      out.addEventListener("click", (event) => {
        event.stopPropagation();
        this.ask({ do: "remove", key });
      });
    });
    if (!now.length) byId("list").innerHTML = '<li class="none">no robot: drop one</li>';
    status.robots = String(now.length);
  }

  admit({ key, body, name, color, born, start }) {
    const facts = { name, color, born, from: new THREE.Vector3(...start), track: new Poses(), way: [] };
    this.robots.add(key, this.robots.bodyOf(body, this.bodies[body]), facts);
    if (this.wanted !== key) return;
    this.follow(key);
    this.wanted = null;
  }

  takePose({ track: { times, rows }, way }, time, pose) {
    if (time <= times[times.length - 1]) return;
    times.push(time);
    rows.push(pose);
    if (times.length > 200) times.splice(0, 100), rows.splice(0, 100);
    if (!way.length || time - way[way.length - 1][0] >= 0.25) way.push([time, pose[0], pose[1]]);
    if (way.length > 480) way.shift();
  }

  takePoses({ t, keys, widths, q }) {
    const numbers = new Float32Array(bytesOf(q));
    let at = 0;
    keys.forEach((key, k) => {
      const robot = this.robots.there.get(key);
      for (const time of t) {
        const pose = numbers.subarray(at, (at += widths[k]));
        if (robot) this.takePose(robot, time, pose);
      }
    });
    this.newest = t[t.length - 1];
    if (this.clock === null || Math.abs(this.newest - this.clock) > 1.5) this.clock = this.newest;
    if (this.busy) this.wait(null);
    status.poses = String(this.newest);
    this.stage.draw();
  }

  // ------------------------------------------------------------------ the current

  // Asks for a current: one command at a time, and the latest after it.
  async pour(velocity) {
    this.setFlow(velocity.map((v) => Number(v.toFixed(4))));
    this.pending = true;
    if (this.sending) return;
    this.sending = true;
    while (this.pending) {
      this.pending = false;
      await this.ask({ do: "current", velocity: this.flow });
    }
    this.sending = false;
  }

  setFlow(velocity) {
    const { stage, size } = this, [x, y, z] = velocity, level = Math.hypot(x, y), all = Math.hypot(level, z);
    byId("flow").textContent = all < 5e-4 ? "still" : `${all.toFixed(3)} m/s`;
    const angle = ((Math.atan2(y, x) * 180) / Math.PI + 360) % 360;
    byId("bearing").textContent = level < 5e-4 ? "" : `${angle.toFixed(0)}° from x towards y`;
    if (!this.holding) byId("lift").value = z;
    if (this.arrow && velocity.join() === this.flow.join()) return;
    this.flow = velocity;
    if (this.arrow) stage.scene.remove(this.arrow.group), release(this.arrow.group);
    // Longer where it is faster, as far as that can be seen.
    const scale = (0.6 * size * Math.min(1, Math.sqrt(all / FASTEST))) / Math.max(all, 1e-9);
    this.arrow = makeCurrent({ values: velocity }, scale, 1, size);
    this.arrow.group.visible = this.isOn("water");
    stage.scene.add(this.arrow.group);
    stage.draw();
  }

  compass() {
    const compass = byId("compass"), lift = byId("lift");
    const drag = (event) => {
      const box = compass.getBoundingClientRect(), r = (45 / 112) * box.width;
      const x = (event.clientX - box.left - box.width / 2) / r, y = -(event.clientY - box.top - box.height / 2) / r;
      const far = Math.hypot(x, y), share = far < 0.06 ? 0 : FASTEST / Math.max(far, 1);
      this.pour([share * x, share * y, this.flow[2]]);
    };
    compass.addEventListener("pointerdown", (event) => {
      this.holding = true;
      compass.setPointerCapture(event.pointerId);
      drag(event);
    });
    compass.addEventListener("pointermove", (event) => this.holding && drag(event));
    for (const end of ["pointerup", "pointercancel"]) compass.addEventListener(end, () => (this.holding = false));
    compass.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-0.02, 0], ArrowRight: [0.02, 0], ArrowUp: [0, 0.02], ArrowDown: [0, -0.02] }[event.key];
      if (!by) return;
      const [x, y, z] = this.flow;
      this.pour([x + by[0], y + by[1], z]);
      event.preventDefault();
      event.stopPropagation();
    });
    lift.addEventListener("input", () => this.pour([this.flow[0], this.flow[1], Number(lift.value)]));
  }

  showCompass() {
    const [x, y] = this.flow, level = Math.hypot(x, y), long = (45 * Math.min(1, level / FASTEST)) / Math.max(level, 1e-9);
    set(byId("stream"), { x2: long * x, y2: -long * y, visibility: level * long > 1 ? "visible" : "hidden" });
    const { x: right, y: ahead } = this.stage.target.clone().sub(this.stage.camera.position).setZ(0).setLength(50);
    set(byId("gaze"), { cx: right, cy: -ahead });
  }

  // ------------------------------------------------------------------ frames

  moves(passed) {
    if (this.clock === null) return !this.busy || this.robots.there.size > 0;
    if (this.paused) {
      this.clock += (this.newest - this.clock) * Math.min(1, 4 * passed);
      return this.gliding || this.newest - this.clock > 1e-3 || this.robots.fading;
    }
    // The clock follows the world's a little behind, without jumps.
    const { rate, speed } = this, behind = Math.min(1, Math.max(rate, 0.2)) * (speed && speed < 0.9 * rate ? 2 : 1);
    const before = this.clock, aimed = this.newest - DELAY * behind;
    this.clock += passed * Math.min(rate, speed || rate) + (aimed - this.clock) * Math.min(1, 2.5 * passed);
    this.clock = Math.min(Math.max(this.clock, before), this.newest);
    this.drift.addScaledVector(new THREE.Vector3(...this.flow), this.clock - before);
    return true;
  }

  speedOf({ track }) {
    return track.speed(this.clock - 1, this.clock) || 0;
  }

  update(seconds) {
    for (const robot of this.robots.there.values()) if (robot.track.times.length) robot.pose(robot.track.at(this.clock));
    if (this.fresh && this.robots.living.some(({ posed }) => posed)) this.all();
    this.fresh &&= this.clock === null;
    this.robots.settle(seconds, this.followed);
    this.aim(this.clock ?? 0, seconds);
    this.stage.dust.material.uniforms.uDrift.value.copy(this.drift);
    this.arrow.update(0, this.focus);
  }

  show() {
    const { stage, world, size, clock, data } = this, there = [...this.robots.there.values()];
    const slow = !this.paused && this.newest !== null && this.speed > 0 && this.speed < 0.85 * this.rate;
    const text = this.paused ? "paused" : this.newest === null ? "–" : `${this.speed.toFixed(2)}×`;
    const more = slow ? "as fast as this machine can" : "";
    this.tell({
      time: { text: clock === null ? "–" : `${clock.toFixed(1)} s`, title: "in the water" },
      pace: { text, more, title: "seconds in the water for each real one" },
      robots: `${this.cast.length} of ${data.room}`,
    });
    if (performance.now() > this.written + 250) {
      this.written = performance.now();
      for (const robot of there) {
        const line = this.lines.get(robot.key);
        if (line && robot.posed) line.children[2].textContent = `${this.speedOf(robot).toFixed(2)} m/s`;
      }
      const robot = this.robots.there.get(this.followed);
      if (!robot?.posed) this.describe(null);
      else {
        this.describe(robot, {
          age: `${Math.max(0, clock - robot.born).toFixed(0)} s`,
          speed: { text: `${this.speedOf(robot).toFixed(3)} m/s`, title: "over ground, over the last second" },
          depth: `${(world.surface - robot.place.z).toFixed(2)} m`,
          "from start": `${robot.place.distanceTo(robot.from).toFixed(2)} m`,
        });
      }
    }
    stage.drawAxes();
    this.showCompass();
    const places = [stage.target, ...there.map(({ place }) => place)], reach = 3 * size + 1;
    const [low, high] = [-1, 1].map((side) => ["x", "y"].map((k) => side * (Math.max(...places.map((p) => side * p[k])) + reach)));
    this.overlay.drawMap(low, high, this.followed, (c, x, y) => {
      c.globalAlpha = 0.55;
      for (const { way, color } of there) {
        c.strokeStyle = color;
        c.beginPath();
        for (const [, a, b] of way) c.lineTo(x(a), y(b));
        c.stroke();
      }
    });
    const place = this.over && this.under(...this.over);
    this.overlay.draw(this.followed, place ? [{ place: place.toArray(), radius: 0.5 * size }] : []);
    status.time = String(clock ?? "");
  }
}

openPage((stage, data) => new Live(stage, data));
