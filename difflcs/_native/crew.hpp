// Threads that stay for the next work, as to start one takes longer than the work of many a call.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

#ifndef _WIN32
#include <pthread.h>
#endif

namespace difflcs {

constexpr auto kAwake = std::chrono::microseconds(300);  // the next work is often so near, and to wake up takes long

class Crew {
 public:
  // Calls work(t) for thread t < threads, 0 on this one. Those that have not begun when this one has done its own never
  // will: each takes of what is left to do. Others of the process may use the threads at the same time, and there may be
  // none to start.
  void run(size_t threads, const std::function<void(size_t)>& work) {
    if (threads < 2) return work(0);
    Job job{&work, threads};
    std::unique_lock<std::mutex> lock(mutex_);
    try {
      for (; size_ + 1 < threads; size_++) std::thread(&Crew::live, this).detach();
    } catch (const std::system_error&) {
    }
    open_.push_back(&job);
    any_ = true;
    lock.unlock();
    for (size_t t = 1; t < threads; t++) come_.notify_one();
    try {
      work(0);
    } catch (...) {
      end(job);
      throw;
    }
    end(job);
  }

  // Calls work(t, i) for all i below count on thread t, until one of them says false.
  template <class Work>
  void each(size_t threads, int64_t count, Work work) {
    std::atomic<int64_t> next{0};
    std::atomic<bool> stop{false};
    run(std::min<size_t>(threads, count), [&](size_t t) {
      for (int64_t i; !stop && (i = next.fetch_add(1)) < count;)
        if (!work(t, i)) stop = true;
    });
  }

  // That of the process. A fork begins without threads.
  static Crew& get() {
    static Crew* crew = new Crew;
#ifndef _WIN32
    static const int forks = pthread_atfork(nullptr, nullptr, [] { crew = new Crew; });
    static_cast<void>(forks);
#endif
    return *crew;
  }

 private:
  struct Job {
    const std::function<void(size_t)>* work;
    const size_t threads;
    size_t begun = 1;
    std::atomic<size_t> at_work{0};
  };

  void end(Job& job) {
    std::unique_lock<std::mutex> lock(mutex_);
    close(&job);
    await(lock, done_, [&] { return job.at_work == 0; });
  }

  void live() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      await(lock, come_, [&] { return any_.load(); });
      Job& job = *open_.front();
      const size_t t = job.begun++;
      job.at_work++;
      if (job.begun == job.threads) close(&job);
      lock.unlock();
      (*job.work)(t);
      lock.lock();
      if (--job.at_work == 0) done_.notify_all();
    }
  }

  void close(Job* job) {
    open_.erase(std::remove(open_.begin(), open_.end(), job), open_.end());
    any_ = !open_.empty();
  }

  // Waits with the lock, which it has not while it waits.
  template <class Ready>
  static void await(std::unique_lock<std::mutex>& lock, std::condition_variable& sign, Ready ready) {
    if (ready()) return;
    lock.unlock();
    const auto until = std::chrono::steady_clock::now() + kAwake;
    while (!ready() && std::chrono::steady_clock::now() < until) std::this_thread::yield();
    lock.lock();
    sign.wait(lock, ready);
  }

  std::mutex mutex_;
  std::condition_variable come_, done_;
  std::vector<Job*> open_;  // that more threads may join
  std::atomic<bool> any_{false};
  size_t size_ = 0;
};

}  // namespace difflcs
