// What pages of robots share: switches, keys, the pointer, the list of robots, the camera.
// `Replay` and `Live` add where their time and their poses come from.

class Page {
  constructor(stage, data, shapes) {
    const { size, many, world } = data;
    Object.assign(this, { stage, data, size, world, lines: new Map(), followed: null, gliding: false, heading: 90 });
    this.robots = new Robots(stage, shapes);
    this.overlay = new Overlay(stage, this.robots);
    this.options = new URLSearchParams(location.hash.slice(1));
    this.spread = many ? 4 : 1; // how much farther than one robot needs things are drawn
    const step = roundNumber(many ? Math.max(0.6 * size, 0.5) : 0.6 * size);
    this.grid = makeGrid(data.floor, this.spread * size, step, world.bed === null);
    stage.scene.add(this.grid);
    byId("grid").title = `level lines, ${step} m apart (G)`;
    if (!many) byId("grid").insertAdjacentHTML("beforeend", ` <small>${step} m</small>`);
    Object.assign(this, { focus: new THREE.Vector3(), arrow: null }); // what is looked at; the current's arrow
  }

  // ------------------------------------------------------------------ switches, keys, pointer

  // Buttons that are pressed or not, by id: what each shows.
  switches(more = {}) {
    const { surface, dust } = this.stage;
    this.shown = {
      names: (on) => (this.overlay.named = on),
      grid: (on) => (this.grid.visible = on),
      water: (on) => {
        surface.mesh.visible = dust.points.visible = on;
        if (this.arrow) this.arrow.group.visible = on;
      },
      ...more,
    };
    for (const name in this.shown) {
      const button = byId(name);
      button?.addEventListener("click", () => this.toggle(name));
      if (button) this.shown[name](this.isOn(name));
    }
  }

  isOn(name) {
    return byId(name).getAttribute("aria-pressed") === "true";
  }

  toggle(name, on = null) {
    const button = byId(name);
    if (!button || button.disabled) return;
    const next = on ?? !this.isOn(name);
    button.setAttribute("aria-pressed", next);
    this.shown[name](next);
    this.stage.draw();
  }

  // What buttons do, by id, and keys, by name; buttons have keys of their own, letters by their small ones.
  listen(acts, keys, rates) {
    const clicks = { follow: () => this.toggleFollow(), all: () => this.all(), ...acts };
    for (const id in clicks) byId(id)?.addEventListener("click", clicks[id]);
    const all = {
      "+": () => this.stage.controls.dollyIn(0.85),
      "-": () => this.stage.controls.dollyOut(0.85),
      "[": () => this.step(-1),
      "]": () => this.step(1),
      ArrowUp: () => this.setRate(rates[Math.min(rates.indexOf(this.rate) + 1, rates.length - 1)]),
      ArrowDown: () => this.setRate(rates[Math.max(rates.indexOf(this.rate) - 1, 0)]),
      Escape: () => this.follow(null),
      ...keys,
    };
    for (const button of document.querySelectorAll("[data-key]")) all[button.dataset.key] = () => button.click();
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      // A control in focus has its own keys; the time's slider is the page's, and letters and blanks slide nothing.
      const own = event.target instanceof HTMLElement && event.target.matches("select, input:not(#scrub)");
      if (own && !(event.key.length === 1 && event.target.matches("[type=range]"))) return;
      if ([" ", "Enter"].includes(event.key) && event.target instanceof HTMLButtonElement) return; // presses it
      const action = all[event.key] ?? all[event.key.toLowerCase()];
      if (!action) return;
      action(event);
      event.preventDefault();
    });
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => this.look(VIEWS[button.dataset.view]));
    }
    const select = byId("rate");
    for (const rate of rates) select.add(new Option(`${rate}×`, rate));
    select.addEventListener("change", () => {
      this.setRate(Number(select.value));
      select.blur();
    });
    this.point();
  }

  point() {
    const canvas = byId("view");
    let down = null;
    canvas.addEventListener("pointerdown", ({ isPrimary, button, clientX: x, clientY: y }) => {
      down = isPrimary && button === 0 ? [x, y] : null;
    });
    canvas.addEventListener("pointerup", (event) => {
      const { clientX: x, clientY: y } = event;
      if (down && Math.hypot(x - down[0], y - down[1]) < 5) this.clicked(x, y, event); // not dragged
      down = null;
    });
    canvas.addEventListener("pointermove", (event) => this.hovered(event));
    byId("map")?.addEventListener("click", (event) => this.onMap(this.overlay.onMap(event)));
  }

  clicked(x, y) {
    const key = this.robots.pick(x, y);
    if (key !== null) this.follow(key);
  }

  hovered({ buttons, clientX: x, clientY: y }) {
    const key = buttons ? null : this.robots.pick(x, y);
    byId("view").style.cursor = key === null ? "" : "pointer";
    if (key !== this.robots.pointed) this.pointAt(key);
  }

  pointAt(key) {
    this.robots.pointed = key;
    this.stage.draw();
  }

  onMap({ key, place }) {
    this.follow(key);
    if (key === null) this.stage.go(new THREE.Vector3(...place, this.stage.target.z));
  }

  playing(on, words) {
    byId("play").setAttribute("aria-label", words);
    byId("play").classList.toggle("playing", on);
    this.stage.draw();
  }

  // ------------------------------------------------------------------ robots

  // Shows `robots` ({ key, name, color }) in the list; `add` dresses a new line.
  list(robots, add = () => {}) {
    const keys = new Set(robots.map(({ key }) => key)), box = byId("list");
    for (const key of this.lines.keys()) if (!keys.has(key)) this.lines.delete(key);
    for (const robot of robots) {
      const { key, name, color } = robot;
      if (this.lines.has(key)) continue;
      const line = byId("entry").content.firstElementChild.cloneNode(true);
      line.children[0].style.background = color;
      line.children[1].textContent = line.children[1].title = name;
      line.addEventListener("click", () => this.follow(this.followed === key ? null : key));
      line.addEventListener("pointerenter", () => this.pointAt(key));
      line.addEventListener("pointerleave", () => this.pointAt(null));
      line.setAttribute("aria-selected", key === this.followed);
      add(line, robot);
      this.lines.set(key, line);
    }
    box.replaceChildren(...robots.map(({ key }) => this.lines.get(key)));
  }

  // The camera goes with a robot, or with none.
  follow(key) {
    this.followed = key;
    this.gliding = key !== null;
    for (const [other, line] of this.lines) line.setAttribute("aria-selected", other === key);
    this.lines.get(key)?.scrollIntoView({ block: "nearest" });
    byId("follow").setAttribute("aria-pressed", key !== null);
    status.followed = key ?? "";
    this.stage.draw();
  }

  toggleFollow() {
    this.follow(this.followed === null ? (this.robots.living[0]?.key ?? null) : null);
  }

  // Follows the next one in the list, or the one before.
  step(by) {
    const keys = this.robots.living.map(({ key }) => key).sort((a, b) => a - b);
    const at = keys.includes(this.followed) ? keys.indexOf(this.followed) : Math.min(-by, 0);
    if (keys.length) this.follow(keys[(at + by + keys.length) % keys.length]);
  }

  // The name and the facts of the robot that is followed; facts may hold several times.
  describe(robot, facts) {
    const box = byId("followed"), [mark, name] = box.firstElementChild.children;
    box.hidden = !robot;
    if (!robot) return;
    mark.style.background = robot.color;
    name.textContent = robot.name;
    this.tell(facts, box.lastElementChild);
  }

  // Writes facts, by name, into a list of terms: text, or { text, title, more }.
  tell(facts, box = byId("facts")) {
    for (const gone of [...box.children].filter(({ dataset }) => !(dataset.name in facts))) gone.remove();
    for (const [name, fact] of Object.entries(facts)) {
      let row = [...box.children].find(({ dataset }) => dataset.name === name);
      if (!row) {
        row = box.appendChild(byId("fact").content.firstElementChild.cloneNode(true));
        row.dataset.name = row.children[0].textContent = name;
        row.children[1].dataset.fact = name;
      }
      const { text, title = "", more = "" } = typeof fact === "string" ? { text: fact } : fact;
      if (row.title !== title) row.title = title;
      [text, more].forEach((words, k) => row.children[k + 1].textContent !== words && (row.children[k + 1].textContent = words));
    }
  }

  // ------------------------------------------------------------------ the camera

  look(view) {
    this.stage.look({ distance: this.followed === null ? 2.1 : 1, ...view }, this.heading);
  }

  // Shows all robots at once, several from above and beside.
  all() {
    this.follow(null);
    const places = this.robots.living.map(({ place }) => place);
    if (!places.length) return;
    const low = places[0].clone(), high = places[0].clone();
    for (const place of places) low.min(place), high.max(place);
    this.stage.target.copy(low).add(high).multiplyScalar(0.5);
    const wide = Math.max(high.distanceTo(low), 2 * this.size) / this.size, distance = Math.max(0.47 * wide, 1.6);
    this.look(places.length > 1 ? { azimuth: 118, elevation: 34, distance } : VIEWS.swim);
  }

  // Water, camera and light at a time, for the robot that is followed, towards which the camera glides.
  aim(time, seconds, placeOf = (robot) => robot.place) {
    const { stage, focus, size } = this, { target, camera, shadow } = stage;
    const robot = this.robots.there.get(this.followed), there = robot?.posed && !robot.leaving;
    if (!robot || robot.leaving) this.gliding = false;
    focus.copy(there ? placeOf(robot) : target);
    if (there && this.gliding) {
      const far = focus.distanceTo(target);
      this.gliding = far >= 0.02 * size;
      if (this.gliding) focus.sub(target).multiplyScalar(Math.min(1, 5 * seconds + 0.02)).add(target);
    }
    stage.place(time, focus, there);
    // Shadows reach as far, and the water is as clear, as what is looked at is far away.
    const far = camera.position.distanceTo(target);
    shadow.reach = Math.min(Math.max(0.85 * size, 0.4 * far), 12 * size);
    shared.uHaze.value = Math.min(1, Math.max(4, 9 * size) / far);
    this.grid.material.uniforms.uReach.value = Math.max(6 * this.spread * size, 1.1 * far);
  }

  start() {
    if (this.options.has("plain")) document.body.classList.add("plain");
    if (innerWidth <= 760) for (const fold of document.querySelectorAll(".fold")) fold.open = false;
    status.ready = "true";
    this.stage.run(this);
  }
}

// Opens the page on its data, if it can be drawn.
async function openPage(make) {
  const data = JSON.parse(byId("data").textContent), stage = openStage(data.world, data.size);
  if (stage === null) return;
  try {
    (await make(stage, data)).start();
  } catch (error) {
    fail(`This page could not be shown: ${error}`);
    throw error;
  }
}
