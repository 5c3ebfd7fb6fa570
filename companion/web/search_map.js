// Draws a moment of the flight on Leaflet. Without tiles the map is a plain grid in metres: x east,
// y north. With tiles the local metres are laid on the globe around the autopilot's origin.
import { leaflet as L } from "nicegui-leaflet";
import { loadResource } from "../../static/utils/resources.js";

const METRES_PER_DEGREE = 111319.49;
const ON_LIGHT = {
  vehicle: "#1d4ed8", estimate: "#c81e4a", second: "#7e22ce", waypoint: "#a16207",
  fence: "#15803d", keepOut: "#991b1b", near: "#15803d", far: "#c2570c", truth: "#111827",
  reported: "#1d4ed8", grid: "#94a3b8", gap: "#7c2d12",
};
const ON_DARK = {
  vehicle: "#60a5fa", estimate: "#fb7185", second: "#c084fc", waypoint: "#facc15",
  fence: "#4ade80", keepOut: "#f87171", near: "#4ade80", far: "#fb923c", truth: "#f8fafc",
  reported: "#60a5fa", grid: "#64748b", gap: "#fdba74",
};
const RING_S = 6; // older rings are gone
const MAX_OPACITY = 0.65;
const CLOSEST_M = 10; // half of the least that is shown when following
const UNDER_WAY = ["normal", "degraded", "hold"]; // phases with a next waypoint
const SITE = [[-50, -50], [50, 50]];

export default {
  template: '<div class="search-map"></div>',
  props: { scene: Object, zooms: Array, resourcePath: String },
  async mounted() {
    await this.$nextTick();
    await loadResource(window.path_prefix + `${this.resourcePath}/leaflet/leaflet.css`);
    this.hasTiles = this.zooms !== null;
    this.origin = null;
    this.fence = {};
    this.isFollowing = true;
    this.isZooming = false;
    this.map = L.map(this.$el, {
      crs: this.hasTiles ? L.CRS.EPSG3857 : L.CRS.Simple,
      minZoom: this.hasTiles ? 2 : -4, maxZoom: this.hasTiles ? 23 : 7,
      zoomSnap: 0.25, attributionControl: false, preferCanvas: false,
    });
    // Leaflet draws on whole pixels, which makes a slim ellipse of few corners bumpy.
    this.map.latLngToLayerPoint = (position) =>
      this.map.project(L.latLng(position)).subtract(this.map.getPixelOrigin());
    this.map.setView([0, 0], this.hasTiles ? 17 : 2);
    if (this.hasTiles) {
      const [minNativeZoom, maxNativeZoom] = this.zooms;
      const address = `${window.path_prefix}/tiles/{z}/{x}/{y}.png${window.location.search}`;
      this.tiles = L.tileLayer(address, { maxZoom: 23, minNativeZoom, maxNativeZoom });
      this.$el.classList.add("on-tiles");
    }
    this.map.createPane("searched").style.zIndex = 350; // between tiles and lines
    this.map.createPane("gap-labels").style.zIndex = 360;
    this.searched = L.layerGroup().addTo(this.map);
    this.searchedVersion = 0;
    this.grid = L.layerGroup().addTo(this.map);
    this.still = L.layerGroup().addTo(this.map);
    this.moving = L.layerGroup().addTo(this.map);
    L.control.scale({ imperial: false }).addTo(this.map);
    this.addCursor();
    this.addButtons();
    this.addLegend();
    this.useColours();
    this.listen();
    this.isReady = true;
    this.fit(SITE);
    this.draw();
  },
  beforeUnmount() {
    this.isReady = false;
    if (this.map) this.map.remove();
    this.map = null;
  },
  methods: {
    listen() {
      this.map.on("dragstart", () => this.follow(false));
      for (const name of ["wheel", "dblclick"]) {
        this.$el.addEventListener(name, () => this.follow(false), { passive: true });
      }
      this.$el.querySelector(".leaflet-control-zoom")
        .addEventListener("click", () => this.follow(false));
      this.map.on("zoomstart", () => { this.isZooming = true; });
      this.map.on("zoomend", () => {
        this.isZooming = false;
        if (this.awaited) this.fit(this.awaited);
        this.draw();
      });
      this.map.on("moveend zoomend", () => this.drawGrid());
      new ResizeObserver(() => this.map && this.map.invalidateSize()).observe(this.$el);
      window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
        if (!this.map) return;
        this.useColours();
        this.drawStill();
        this.drawGrid();
        this.drawSearched();
        this.draw();
      });
    },
    useColours() {
      const isDark = window.matchMedia("(prefers-color-scheme: dark)").matches;
      this.colours = isDark && !this.hasTiles ? ON_DARK : ON_LIGHT;
      for (const sign of this.$el.querySelectorAll(".legend [data-colour]")) {
        sign.style.setProperty("--colour", this.colours[sign.dataset.colour]);
      }
    },
    addButtons() {
      const bar = L.DomUtil.create("div", "leaflet-bar map-buttons");
      const add = (text, hint, act) => {
        const button = L.DomUtil.create("button", "", bar);
        button.type = "button";
        button.textContent = text;
        button.title = hint;
        button.addEventListener("click", act);
        return button;
      };
      this.followButton = add("Follow", "Keep vehicle and estimate in view",
        () => this.follow(true));
      add("Whole", "Show everything inside the fence", () => this.fitAll());
      if (this.scene.pod_colours) {
        this.searchedButton = add("Searched", "Show the searched area and its gaps",
          () => this.switchSearched(!this.isSearchedOn));
        this.searchedButton.id = "button-searched";
      }
      L.DomEvent.disableClickPropagation(bar);
      const control = L.control({ position: "topright" });
      control.onAdd = () => bar;
      control.addTo(this.map);
      this.follow(true);
    },
    addCursor() { // degrees under the mouse, or where a finger was
      const box = L.DomUtil.create("div", "cursor");
      box.title = "Latitude and longitude under the mouse";
      const control = L.control({ position: "bottomleft" });
      control.onAdd = () => box;
      control.addTo(this.map);
      this.map.on("mousemove click", ({ latlng }) => {
        const position = this.hasTiles ? [latlng.lat, latlng.lng] : this.degrees(latlng);
        box.textContent = this.origin ? position.map((each) => each.toFixed(6)).join(", ") : "";
      });
    },
    degrees({ lat: north, lng: east }) {
      const [lat, lon] = this.origin || [0, 0];
      const scale = METRES_PER_DEGREE * Math.cos((lat * Math.PI) / 180);
      return [lat + north / METRES_PER_DEGREE, lon + east / scale];
    },
    addLegend() {
      const box = L.DomUtil.create("details", "legend");
      box.open = this.$el.clientWidth >= 800 && this.$el.clientHeight >= 500; // covers a smaller map
      L.DomUtil.create("summary", "", box).textContent = "Legend";
      const add = (sign, colour, text) => {
        const row = L.DomUtil.create("div", "", box);
        L.DomUtil.create("i", `sign-${sign}`, row).dataset.colour = colour;
        L.DomUtil.create("span", "", row).textContent = text;
      };
      add("dot", "vehicle", "vehicle and its track");
      if (this.scene.pod_colours) {
        add("scale", "gap", "POD, 0 to 100 %");
        const [low, high] = this.scene.pod_colours;
        box.lastChild.firstChild.style.background = `linear-gradient(90deg, ${low}, ${high})`;
        add("dashed-box", "gap", "gap: POD below 50 %");
      }
      if (this.scene.has_antenna) add("dotted", "vehicle", "what its antenna sees on the ground");
      add("area", "estimate", "estimate, 95 % ellipse");
      add("dotted", "estimate", "R95, relative");
      add("dashed", "estimate", "R95, absolute");
      add("dot", "second", "second possible position");
      add("ring", "waypoint", "next waypoint");
      add("ring", "near", "range, line of sight");
      add("dashed", "far", "range, treated as reflected");
      add("edge", "fence", "fence that is kept");
      add("area", "keepOut", "keep-out");
      if (this.scene.truth) add("ring", "truth", "true position (simulator)");
      L.DomEvent.disableClickPropagation(box);
      const control = L.control({ position: "bottomright" });
      control.onAdd = () => box;
      control.addTo(this.map);
    },
    follow(isOn) {
      this.isFollowing = isOn;
      this.followButton.classList.toggle("is-on", isOn);
      if (isOn) this.draw();
    },
    at(point) {
      const [east, north] = point;
      if (!this.hasTiles) return [north, east];
      return this.degrees({ lat: north, lng: east });
    },
    line(points, style) {
      return L.polyline(points.map(this.at), { interactive: false, smoothFactor: 0.5, ...style });
    },
    area(points, style) {
      return L.polygon(points.map(this.at), { interactive: false, smoothFactor: 0, ...style });
    },
    dot(point, radius, style) {
      return L.circleMarker(this.at(point), { radius, interactive: false, weight: 2, ...style });
    },
    corners(centre, radiusM, count) {
      return Array.from({ length: count }, (_, i) => {
        const turn = (2 * Math.PI * i) / count;
        return [centre[0] + radiusM * Math.cos(turn), centre[1] + radiusM * Math.sin(turn)];
      });
    },
    ring(centre, radiusM, style) {
      return this.area(this.corners(centre, radiusM, 72), { fill: false, ...style });
    },
    fit(points) {
      this.awaited = this.isZooming ? points : null; // Leaflet ignores what comes while it zooms
      if (!this.isZooming) this.map.fitBounds(points.map(this.at), { padding: [24, 24] });
    },
    fitAll() {
      this.follow(false);
      const { estimate, vehicle } = this.picture || {};
      const points = [...(this.fence.polygon || SITE)];
      if (vehicle) points.push(vehicle);
      if (estimate) points.push(estimate.position);
      this.fit(points);
    },
    keepInView(picture) {
      const { estimate, vehicle, waypoint } = picture;
      const points = [];
      if (vehicle) points.push(...this.corners(vehicle, CLOSEST_M, 4));
      if (waypoint && UNDER_WAY.includes(picture.phase)) points.push(waypoint.position);
      if (estimate) {
        const reachM = Math.max(CLOSEST_M, estimate.absolute_r95_m);
        points.push(...this.corners(estimate.position, reachM, 4));
      }
      if (!points.length) return;
      const wanted = L.latLngBounds(points.map(this.at));
      const shown = this.map.getBounds();
      const share = Math.max(
        (wanted.getEast() - wanted.getWest()) / (shown.getEast() - shown.getWest()),
        (wanted.getNorth() - wanted.getSouth()) / (shown.getNorth() - shown.getSouth()));
      if (share < 0.35 || !shown.contains(wanted)) this.map.fitBounds(wanted.pad(0.25));
    },
    drawStill() {
      this.still.clearLayers();
      const { colours } = this;
      const { polygon, also_inside: alsoInside, keep_out: keepOut } = this.fence;
      for (const corners of polygon ? [polygon, ...(alsoInside || [])] : []) {
        this.still.addLayer(this.area(corners,
          { color: colours.fence, weight: 2, dashArray: "6 4", fill: false, className: "fence" }));
      }
      for (const corners of keepOut || []) {
        this.still.addLayer(this.area(corners,
          { color: colours.keepOut, weight: 1, fillOpacity: 0.25, className: "keep-out" }));
      }
      if (this.scene.truth) {
        this.still.addLayer(this.dot(this.scene.truth, 9,
          { color: colours.truth, weight: 1.5, fill: false, className: "truth" }));
      }
    },
    drawGrid() {
      if (!this.map || this.hasTiles) return;
      this.grid.clearLayers();
      const bounds = this.map.getBounds();
      const [w, e, s, n] = [bounds.getWest(), bounds.getEast(), bounds.getSouth(), bounds.getNorth()];
      const { x: width, y: height } = this.map.getSize();
      const pixel = (e - w) / Math.max(1, width);
      let step = 1;
      for (const factor of [2, 2.5, 2, 2, 2.5, 2, 2, 2.5, 2]) if (step / pixel < 70) step *= factor;
      const style = { color: this.colours.grid, weight: 0.5, opacity: 0.7 };
      for (let x = Math.ceil(w / step) * step; x <= e; x += step) {
        this.grid.addLayer(this.line([[x, s], [x, n]], style));
        const isFree = (x - w) / pixel > 130 && (e - x) / pixel > 130;
        if (isFree && width > 300) this.label([x, n], "below", `${Math.abs(x)} m ${x < 0 ? "W" : "E"}`);
      }
      for (let y = Math.ceil(s / step) * step; y <= n; y += step) {
        this.grid.addLayer(this.line([[w, y], [e, y]], style));
        const isFree = (y - s) / pixel > 50 && (n - y) / pixel > 120;
        if (isFree && height > 300) this.label([w, y], "beside", `${Math.abs(y)} m ${y < 0 ? "S" : "N"}`);
      }
    },
    label(point, where, text, layer = this.grid, pane = "markerPane") {
      const icon = L.divIcon({ className: `grid-label ${where}`, html: text, iconSize: null });
      layer.addLayer(L.marker(this.at(point), { icon, pane, interactive: false, keyboard: false }));
    },
    show(picture, points, isWhole) {
      this.track = isWhole ? points : [...(this.track || []), ...points];
      this.picture = picture;
      this.draw();
      this.showSearched(picture);
    },
    showSearched(picture) {
      if (!this.isReady || !this.searchedButton) return;
      const isSearching = picture.searched !== null; // at contact the estimate needs the map
      if (isSearching !== this.isSearching) this.switchSearched(isSearching);
      this.isSearching = isSearching;
      if (this.isSearchedOn) this.loadSearched(picture.searched_version);
    },
    switchSearched(isOn) {
      this.isSearchedOn = isOn;
      this.searchedButton.classList.toggle("is-on", isOn);
      this.searchedButton.setAttribute("aria-pressed", isOn);
      this.drawSearched();
    },
    async loadSearched(version) {
      if (version === this.searchedVersion || this.isLoading) return;
      this.isLoading = true;
      try {
        const path = `${window.path_prefix}/searched.json${window.location.search}`;
        const answer = await (await fetch(path)).json();
        this.searchedVersion = answer.version;
        this.searchedArea = answer.area;
        this.drawSearched();
      } catch (error) {
        console.warn("searched area:", error.message); // the next picture asks again
      } finally {
        this.isLoading = false;
      }
    },
    drawSearched() {
      if (!this.map) return;
      this.searched.clearLayers();
      if (!this.isSearchedOn || !this.searchedArea) return;
      const { image, corners, gaps } = this.searchedArea;
      this.searched.addLayer(L.imageOverlay(image, corners.map(this.at),
        { pane: "searched", className: "pod" }));
      for (const gap of gaps) {
        for (const { outside_enu_m: outside, holes_enu_m: holes } of gap.outlines) {
          const rings = [outside, ...holes].map((ring) => ring.map(this.at));
          this.searched.addLayer(L.polygon(rings, { pane: "searched", interactive: false,
            smoothFactor: 0, color: this.colours.gap, weight: 2, dashArray: "6 3", fill: false,
            className: "gap" }));
        }
        this.label(gap.label, "gap-label", gap.text, this.searched, "gap-labels");
      }
    },
    draw() {
      const { picture } = this;
      if (!this.isReady || this.isZooming || !picture) return;
      const isElsewhere = `${picture.origin}` !== `${this.origin}`;
      if (isElsewhere) this.origin = picture.origin;
      if (this.hasTiles && this.origin) this.tiles.addTo(this.map);
      if (JSON.stringify(picture.fence) !== JSON.stringify(this.fence)
        || (this.hasTiles && isElsewhere)) {
        this.fence = picture.fence;
        this.drawStill();
        this.drawSearched();
        if (this.isFollowing) this.fit(this.fence.polygon || SITE);
      }
      if (this.isFollowing) this.keepInView(picture);
      this.moving.clearLayers();
      const add = (layer) => this.moving.addLayer(layer);
      for (const mark of picture.marks || []) this.drawMark(mark, picture, add);
      if (this.track.length && picture.vehicle) {
        add(this.line([...this.track, picture.vehicle.slice(0, 2)],
          { color: this.colours.vehicle, weight: 2, opacity: 0.75, className: "track" }));
      }
      this.drawAntenna(picture, add);
      this.drawOthers(picture.emitters || [], add);
      this.drawEstimate(picture.estimate, add);
      this.drawPlan(picture, add);
      if (picture.vehicle) {
        add(this.dot(picture.vehicle, 7, {
          color: "#ffffff", fillColor: this.colours.vehicle, fillOpacity: 1, className: "vehicle",
        }));
      }
    },
    drawAntenna({ antenna, vehicle }, add) {
      if (!antenna || !vehicle) return;
      const color = this.colours.vehicle;
      if (antenna.outline.length) {
        add(this.area(antenna.outline,
          { color, weight: 1, dashArray: "1 5", fillOpacity: 0.08, className: "antenna-view" }));
      }
      add(this.line([vehicle.slice(0, 2), antenna.ahead],
        { color, weight: 1, opacity: 0.6, className: "boresight" }));
    },
    drawMark(mark, picture, add) {
      const freshness = 1 - (picture.t_s - mark.t_s) / RING_S;
      if (freshness <= 0) return;
      const { near, far } = this.colours;
      const weight = mark.range_weight === null ? 1 : mark.range_weight;
      const style = weight > 0.9 ? { color: near, weight: 1.5 }
        : { color: far, weight: 1, dashArray: "3 5" };
      style.opacity = MAX_OPACITY * Math.min(1, freshness) * (0.4 + 0.6 * weight);
      if (mark.range_m !== null) {
        add(this.ring(mark.sensor_enu_m, mark.range_m, { ...style, className: "range" }));
      }
      if (mark.bearing_enu_rad !== null) {
        const [east, north] = mark.sensor_enu_m;
        const reach = mark.range_m === null ? 100 : mark.range_m;
        const end = [east + reach * Math.cos(mark.bearing_enu_rad),
          north + reach * Math.sin(mark.bearing_enu_rad)];
        add(this.line([[east, north], end], { ...style, className: "bearing" }));
      }
    },
    drawEstimate(estimate, add) {
      if (!estimate) return;
      const color = this.colours.estimate;
      add(this.area(estimate.ellipse, { color, weight: 2, fillOpacity: 0.25, className: "ellipse" }));
      add(this.ring(estimate.position, estimate.r95_m,
        { color, weight: 1.5, dashArray: "2 4", className: "r95" }));
      add(this.ring(estimate.position, estimate.absolute_r95_m,
        { color, weight: 1, dashArray: "8 6", className: "absolute-r95" }));
      add(this.dot(estimate.position, 4, { color, fillOpacity: 1, className: "estimate" }));
      if (estimate.alternative) {
        add(this.dot(estimate.alternative, 6, { color: this.colours.second, className: "second" }));
      }
    },
    drawOthers(emitters, add) {
      for (const emitter of emitters) {
        if (emitter.is_current || !emitter.position) continue;
        const color = emitter.is_reported ? this.colours.reported : this.colours.estimate;
        add(this.ring(emitter.position, emitter.r95_m,
          { color, weight: 1, dashArray: "2 4", className: "other-r95" }));
        add(this.ring(emitter.position, emitter.absolute_r95_m,
          { color, weight: 1, dashArray: "8 6", className: "other-absolute-r95" }));
        add(this.dot(emitter.position, 5, { color, fillOpacity: 0.6, className: "other-emitter" }));
      }
    },
    drawPlan(picture, add) {
      if (!picture.waypoint || !UNDER_WAY.includes(picture.phase)) return;
      const color = this.colours.waypoint;
      if (picture.vehicle) {
        add(this.line([picture.vehicle.slice(0, 2), picture.waypoint.position],
          { color, weight: 1.5, dashArray: "4 4" }));
      }
      add(this.dot(picture.waypoint.position, 6, { color, className: "waypoint" }));
    },
  },
};
